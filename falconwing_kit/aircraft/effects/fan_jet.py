"""Fan jet: a round jet of air in one part of the hall, or a wider one outdoors."""

from math import cos, pi, sin
from typing import Any

import numpy as np

from falconwing_kit.aircraft.effect import FLIGHT_RADIUS_M, Effect, draw_direction
from falconwing_kit.aircraft.terms import Parameter
from falconwing_kit.core.checks import Array

COLUMNS, ROWS = 7, 4  # grid of places where a scan looks for it
OUTDOORS_M = 40.0  # length of the area flown, above which there is no hall around it


def fan_jet(px: Any, py: Any, height: Any, time: Any, K: Any) -> tuple[Any, Any, Any]:
    """(jet_x, jet_y) exp(-d^2 / 2 R^2), d the horizontal distance from its centre, R jet_radius."""
    distance2 = (px - K.jet_at_x) ** 2 + (py - K.jet_at_y) ** 2
    share = np.exp(-0.5 * distance2 / (K.jet_radius * K.jet_radius))
    return K.jet_x * share, K.jet_y * share, 0.0


def grid(low: Array, high: Array) -> list[dict[str, float]]:
    """Centres on a grid over the area flown."""
    xs, ys = np.linspace(low[0], high[0], COLUMNS), np.linspace(low[1], high[1], ROWS)
    return [{"jet_at_x": float(x), "jet_at_y": float(y)} for x in xs for y in ys]


def wide_jet(px: Any, py: Any, height: Any, time: Any, K: Any) -> tuple[Any, Any, Any]:
    """The same profile, of a stream that is wider than a hall."""
    distance2 = (px - K.stream_at_x) ** 2 + (py - K.stream_at_y) ** 2
    share = np.exp(-0.5 * distance2 / (K.stream_radius * K.stream_radius))
    return K.stream_x * share, K.stream_y * share, 0.0


def wide_grid(low: Array, high: Array) -> list[dict[str, float]]:
    """Centres on the same grid, as far apart as the stream is wide; none in a hall."""
    length = float(np.max(np.asarray(high) - np.asarray(low)))
    if length < OUTDOORS_M:
        return []
    radius = {"stream_radius": length / (COLUMNS - 1)}
    return [
        {name.replace("jet", "stream"): place for name, place in point.items()} | radius
        for point in grid(low, high)
    ]


def draw(rng: np.random.Generator, size: float) -> dict[str, float]:
    """A jet of this speed, its centre near one of the circles that a hidden flight flies."""
    around = rng.uniform(0.0, 2.0 * pi)
    circle = rng.choice([-FLIGHT_RADIUS_M, FLIGHT_RADIUS_M])
    centre = {
        "jet_at_x": float(circle + FLIGHT_RADIUS_M * cos(around)),
        "jet_at_y": FLIGHT_RADIUS_M * sin(around),
    }
    speed = draw_direction("jet_x", "jet_y")(rng, size)
    return {**speed, **centre, "jet_radius": float(rng.uniform(1.5, 3.0))}


EFFECTS = (
    Effect(
        name="fan_jet",
        physics="Air streams through one part of a field only: a gap between buildings or trees.",
        parameters=(
            Parameter("stream_x", 1.0, -30.0, 30.0, "m/s", "air speed along world x at its centre"),
            Parameter("stream_y", 1.0, -30.0, 30.0, "m/s", "air speed along world y at its centre"),
            Parameter("stream_at_x", 0.0, -3000.0, 3000.0, "m", "x of its centre"),
            Parameter("stream_at_y", 0.0, -3000.0, 3000.0, "m", "y of its centre"),
            Parameter(
                "stream_radius",
                30.0,
                5.0,
                500.0,
                "m",
                "radius, one standard deviation of its profile",
            ),
        ),
        equation=(
            "V_a = V_g - ({stream_x}, {stream_y}, 0) exp(-d^2 / (2 R^2)), R = {stream_radius}, "
            "d^2 = (x - {stream_at_x})^2 + (y - {stream_at_y})^2"
        ),
        wind_field=wide_jet,
        scan_points=wide_grid,
        shape=("stream_at_x", "stream_at_y", "stream_radius"),
        contains=("wind",),
        acts_on=("air",),
        place=("stream_at_x", "stream_at_y"),
        separated_by={"passes": "a stream acts in one place only"},
        frozen_number=1,
    ),
    Effect(
        name="fan_jet",
        physics="A fan blows through one part of the hall only.",
        parameters=(
            Parameter("jet_x", 0.3, -8.0, 8.0, "m/s", "air speed along world x at its centre"),
            Parameter("jet_y", 0.3, -8.0, 8.0, "m/s", "air speed along world y at its centre"),
            Parameter("jet_at_x", 0.0, -60.0, 60.0, "m", "x of its centre"),
            Parameter("jet_at_y", 0.0, -60.0, 60.0, "m", "y of its centre"),
            Parameter(
                "jet_radius", 2.5, 0.7, 8.0, "m", "radius, one standard deviation of its profile"
            ),
        ),
        equation=(
            "V_a = V_g - ({jet_x}, {jet_y}, 0) exp(-d^2 / (2 R^2)), R = {jet_radius}, "
            "d^2 = (x - {jet_at_x})^2 + (y - {jet_at_y})^2"
        ),
        wind_field=fan_jet,
        scan_points=grid,
        shape=("jet_at_x", "jet_at_y", "jet_radius"),
        contains=("wind",),
        acts_on=("air",),
        place=("jet_at_x", "jet_at_y"),
        separated_by={"passes": "a jet acts in one place only"},
        sizes=(0.4, 1.4, 3.0),
        draw=draw,
        frozen_number=1,
    ),
)
