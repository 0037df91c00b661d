"""learning: the simulator's views -> trained networks.

Its files load torch; importing the package does not.
"""
