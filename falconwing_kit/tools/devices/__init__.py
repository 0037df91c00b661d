"""devices: cameras and the frame grabber."""
