"""networks: the learned parts of vision, in plain torch, which all of this loads; their doors are in vision."""
