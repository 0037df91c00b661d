"""control: the expert pilot, its loops and guidance, and the leaders that others follow."""

from falconwing_kit.control.estimate import FlyingAircraft, Observer
from falconwing_kit.control.expert import FollowExpert, LandingExpert, WaypointExpert, landing_path
from falconwing_kit.control.guidance import Hall, Path, require_flyable
from falconwing_kit.control.leader import MANOEUVRES, LeaderPath, leader_path
from falconwing_kit.control.loops import (
    LATERAL,
    LONGITUDINAL,
    Autopilot,
    Axis,
    Loop,
    Reference,
    TrimTable,
    design_loop,
    path_axes,
    with_delay,
)

__all__ = [
    "LATERAL",
    "LONGITUDINAL",
    "MANOEUVRES",
    "Autopilot",
    "Axis",
    "FlyingAircraft",
    "FollowExpert",
    "Hall",
    "LandingExpert",
    "LeaderPath",
    "Loop",
    "Observer",
    "Path",
    "Reference",
    "TrimTable",
    "WaypointExpert",
    "design_loop",
    "landing_path",
    "leader_path",
    "path_axes",
    "require_flyable",
    "with_delay",
]
