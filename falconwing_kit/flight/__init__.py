"""flight: the simulated world, image sources, the 20 Hz loop, its tasks and their trials."""

from falconwing_kit.flight.world import Contact, PoseFilter, PoseNoise, SimulatedWorld

__all__ = ["Contact", "PoseFilter", "PoseNoise", "SimulatedWorld"]
