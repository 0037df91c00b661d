"""vision: what images say: the frame monitor, and where live images come from."""
