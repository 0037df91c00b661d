"""training: photos with poses -> Gaussians. Everything here loads torch; `scene/fit.py` is the door."""
