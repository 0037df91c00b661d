"""Right-turn S ascent [paper, Section V-A]: random draws -> waypoints of the mirrored S, up."""

from falconwing_kit.control.manoeuvres.left_turn_s_descent import S_KNOTS, S_LEFT
from falconwing_kit.control.plan import Manoeuvre, Plan

S_RIGHT = tuple(-curvature for curvature in S_LEFT)
PLAN = Plan((-16.0, 1.0, 1.3), 0.0, S_KNOTS, S_RIGHT, (0.0, 0.0, 5.0, 6.0, 6.0, 5.0, 0.0, 0.0))
MANOEUVRE = Manoeuvre(
    "right_turn_s_ascent", "an S that begins to the right, climbing", PLAN.waypoints, 1
)
