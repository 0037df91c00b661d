"""Figure eight: random draws -> waypoints of two level circles, radius 8.9 m, right then left."""

from falconwing_kit.control.plan import Manoeuvre, Plan

# The arc length closes each lobe in the middle.
LOBE = (0.0, 1.0, 5.0, 51.184, 55.184, 56.184)  # [m]
RIGHT_LOBE = (0.0, 0.0, 1 / 8.9, 1 / 8.9, 0.0, 0.0)  # [1/m]
PLAN = Plan(
    start=(-2.5, -2.0, 2.2),
    yaw_deg=-71.536,
    s=(*LOBE, *(56.184 + s for s in LOBE[1:])),
    curvature=(*RIGHT_LOBE, *(-curvature for curvature in RIGHT_LOBE[1:])),
    climb_deg=(0.0,) * 11,
    shift=(0.1, 0.1, 0.2),  # it fills the hall
    stretch=0.0,
)
MANOEUVRE = Manoeuvre(
    "figure_eight", "two level circles, to the right and then to the left", PLAN.waypoints, 3
)
