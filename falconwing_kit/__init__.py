"""FalconWing kit: recorded flights and airframe data -> model and its prediction error."""

__version__ = "0.2.0"
