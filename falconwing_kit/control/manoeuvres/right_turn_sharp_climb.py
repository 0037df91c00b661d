"""Right-turn sharp climb [paper, Section V-A]: random draws -> a long right turn, 11 deg up."""

from falconwing_kit.control.plan import Manoeuvre, Plan

PLAN = Plan(
    start=(-2.0, 5.5, 1.2),
    yaw_deg=0.0,
    s=(0.0, 3.0, 7.0, 15.0, 17.0, 19.0, 21.0, 25.0),
    curvature=(0.0, 0.0, 0.1, 0.1, 0.1, 0.05, 0.0, 0.0),
    climb_deg=(0.0, 1.0, 11.0, 11.0, 6.0, 1.0, 0.0, 0.0),
)
MANOEUVRE = Manoeuvre(
    "right_turn_sharp_climb", "a long turn to the right, climbing steeply", PLAN.waypoints, 2
)
