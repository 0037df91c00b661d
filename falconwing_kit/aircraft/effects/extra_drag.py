"""Extra drag: an added part in the air flow."""

from typing import Any

from falconwing_kit.aircraft.effect import Effect, draw_size
from falconwing_kit.aircraft.terms import Flow, Loads, Parameter, drag_loads


def extra_drag(air: Flow, K: Any) -> Loads:
    """More drag at zero lift: D/m = V^2 drag_added."""
    return drag_loads(air, air.airspeed * K.drag_added)


EFFECTS = (
    Effect(
        name="extra_drag",
        physics="An added part has drag, which grows with the square of speed at any throttle.",
        parameters=(Parameter("drag_added", 0.003, 0.0, 0.3, "1/m", "drag added at zero lift"),),
        equation="D/m -> D/m + {drag_added} V^2",
        loads=extra_drag,
        acts_on=("along",),
        same_form=("drag with airspeed squared",),
        separated_by={
            "glides": "drag slows a glide too",
            "fast flight": "drag grows with the square of speed",
        },
        sizes=(0.005, 0.01, 0.02),
        draw=draw_size("drag_added"),
        frozen_number=3,
    ),
)
