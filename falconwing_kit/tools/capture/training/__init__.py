"""photos with poses -> a trained Gaussian scene. Each file here loads torch."""
