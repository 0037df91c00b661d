"""control: the expert pilot, its loops and guidance, and the leaders that others follow."""

from falconwing_kit.control.estimate import FlyingAircraft, Observer
from falconwing_kit.control.expert import FollowExpert, LandingExpert, WaypointExpert, landing_path
from falconwing_kit.control.guidance import Hall, Path, require_flyable
from falconwing_kit.control.leader import LeaderPath, leader_path
from falconwing_kit.control.loops import (
    LATERAL,
    LONGITUDINAL,
    Autopilot,
    Axis,
    ClosedLoop,
    Reference,
    TrimTable,
    course_axes,
    design_loop,
    with_delay,
)
from falconwing_kit.control.manoeuvres import MANOEUVRES

__all__ = [
    "LATERAL",
    "LONGITUDINAL",
    "MANOEUVRES",
    "Autopilot",
    "Axis",
    "ClosedLoop",
    "FlyingAircraft",
    "FollowExpert",
    "Hall",
    "LandingExpert",
    "LeaderPath",
    "Observer",
    "Path",
    "Reference",
    "TrimTable",
    "WaypointExpert",
    "course_axes",
    "design_loop",
    "landing_path",
    "leader_path",
    "require_flyable",
    "with_delay",
]
