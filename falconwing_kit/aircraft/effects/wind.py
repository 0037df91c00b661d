"""Wind: the air as a whole moves over the floor."""

from dataclasses import replace

from falconwing_kit.aircraft.effect import Effect, draw_direction
from falconwing_kit.aircraft.terms import WIND_PARAMETERS, uniform_wind

EFFECTS = (
    Effect(
        name="wind",
        physics="The air moves as a whole: velocity through the air is not that over the floor.",
        parameters=tuple(replace(p, start=0.3) for p in WIND_PARAMETERS),
        equation="V_a = V_g - ({wind_x}, {wind_y}, 0), V_a through the air, V_g over the ground",
        wind_field=uniform_wind,
        acts_on=("air",),
        same_form=("wind along x", "wind along y"),
        separated_by={
            "circles": "the wind comes from every side in turn",
            "passes": "a uniform wind is the same beside the place",
        },
        sizes=(0.05, 0.3, 1.2),
        draw=draw_direction("wind_x", "wind_y"),
        frozen_number=0,
    ),
)
