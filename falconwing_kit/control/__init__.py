"""control: the expert pilot, its loops and guidance, and the leaders that others follow."""

from falconwing_kit.control.estimate import Observer, SimulatedAircraft
from falconwing_kit.control.expert import (
    FollowExpert,
    LandingExpert,
    WaypointExpert,
    landing_path,
    landing_speed,
)
from falconwing_kit.control.guidance import Hall, ReferencePath, require_flyable
from falconwing_kit.control.leader import LeaderPath, leader_path
from falconwing_kit.control.loops import (
    LATERAL,
    LONGITUDINAL,
    Autopilot,
    Axis,
    ClosedLoop,
    Reference,
    TrimTable,
    augment_delay,
    course_axes,
    design_loop,
)
from falconwing_kit.control.manoeuvres import MANOEUVRES

__all__ = [
    "LATERAL",
    "LONGITUDINAL",
    "MANOEUVRES",
    "Autopilot",
    "Axis",
    "ClosedLoop",
    "FollowExpert",
    "Hall",
    "LandingExpert",
    "LeaderPath",
    "Observer",
    "Reference",
    "ReferencePath",
    "SimulatedAircraft",
    "TrimTable",
    "WaypointExpert",
    "augment_delay",
    "course_axes",
    "design_loop",
    "landing_path",
    "landing_speed",
    "leader_path",
    "require_flyable",
]
