"""link: what a video link does to the pictures that poses are read off."""
