"""FalconWing kit: recorded flights and airframe data in, an aircraft model and its honest error
out.
"""

__version__ = "0.2.0"
