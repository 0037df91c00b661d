"""FalconWing kit: recorded flights and airframe data -> aircraft model with its prediction error."""

__version__ = "0.2.0"
