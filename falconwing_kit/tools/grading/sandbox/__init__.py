"""sandbox: a box that runs what a student wrote and cannot be talked into anything else."""
