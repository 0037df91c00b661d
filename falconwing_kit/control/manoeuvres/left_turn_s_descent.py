"""Left-turn S descent [paper, Section V-A]: random draws -> waypoints to the left, back, down."""

from falconwing_kit.control.plan import Manoeuvre, Plan

S_KNOTS = (0.0, 4.0, 7.0, 12.0, 17.0, 22.0, 25.0, 29.0)  # [m]
S_LEFT = (0.0, 0.0, -0.09, -0.09, 0.09, 0.09, 0.0, 0.0)  # [1/m]
PLAN = Plan((-16.0, -5.0, 3.5), 0.0, S_KNOTS, S_LEFT, (0.0, 0.0, -5.0, -6.0, -6.0, -5.0, 0.0, 0.0))
MANOEUVRE = Manoeuvre(
    "left_turn_s_descent", "an S that begins to the left, descending", PLAN.waypoints, 0
)
