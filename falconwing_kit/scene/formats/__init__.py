"""formats: Gaussian scenes <-> files of other programs (.ply, .splat, SPZ, SOG) and the kit's own .npz."""
