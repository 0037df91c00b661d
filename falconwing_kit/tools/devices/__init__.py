"""cameras and frame grabbers."""
