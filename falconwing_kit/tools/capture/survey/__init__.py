"""what is measured on photos to align them with the world."""
