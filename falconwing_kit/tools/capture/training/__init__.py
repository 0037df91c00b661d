"""Training: photos with poses -> Gaussian scene. Every file here loads torch."""
