"""learning: the simulator's views -> trained networks. Its files load torch, this one does not."""
