"""Plans: a start and a course's curvature and climb -> the waypoints of a manoeuvre; a manoeuvre's
record.
"""

import math
import zlib
from collections.abc import Callable, Iterable
from dataclasses import dataclass

import numpy as np

from falconwing_kit.core.checks import Array, InputError

MARGIN = 1.0  # m that a leader keeps from walls and beams; its half span is 0.35 m
MIN_HEIGHT = 0.7  # m above the floor


@dataclass(frozen=True)
class Manoeuvre:
    """What a leader can fly."""

    name: str
    summary: str  # as `fly --help` shows it
    waypoints: Callable[
        [np.random.Generator], Array
    ]  # (n, 3) [m], about a metre apart; draws from the generator
    frozen_number: int | None = (
        None  # of the first five, whose flights are recorded; a later one has none
    )

    @property
    def number(self) -> int:
        """Part of the random generator's key: of the manoeuvre itself, so that no other one changes
        it.
        """
        return zlib.crc32(self.name.encode()) if self.frozen_number is None else self.frozen_number


def manoeuvre_table(manoeuvres: Iterable[Manoeuvre]) -> dict[str, Manoeuvre]:
    """Manoeuvres by name, in the order of their numbers.

    Raises:
        InputError: two have the same name or number.
    """
    table: dict[str, Manoeuvre] = {}
    for manoeuvre in sorted(manoeuvres, key=lambda one: one.number):
        for other in table.values():
            if manoeuvre.name == other.name or manoeuvre.number == other.number:
                raise InputError(
                    f"manoeuvre {manoeuvre.name}: expected a name and a number of its own, got those of {other.name}"
                    f" ({other.number}): choose another name"
                )
        table[manoeuvre.name] = manoeuvre
    return table


@dataclass(frozen=True)
class Plan:
    """A manoeuvre on paper: its first point and course, its curvature and climb, linear between the
    knots.

    The hall is 40 m long, and the paper's manoeuvres begin 6.5 m from its end so that a follower
    has room behind.
    """

    start: tuple[float, float, float]  # [m]
    yaw_deg: float
    s: tuple[float, ...]  # knots along the way [m]
    curvature: tuple[float, ...]  # at the knots, positive to the right [1/m]
    climb_deg: tuple[float, ...]  # at the knots
    shift: tuple[float, float, float] = (
        0.5,
        0.5,
        0.2,
    )  # a seed moves it by up to so much each way [m]
    stretch: float = 0.05  # and enlarges it by up to this share

    def waypoints(self, rng: np.random.Generator) -> Array:
        """A point every metre (n, 3) [m], moved and enlarged by the seed's draws."""
        start = np.array(self.start) + rng.uniform(-1.0, 1.0, 3) * self.shift
        way = curve_points(
            math.radians(self.yaw_deg),
            np.array(self.s),
            np.array(self.curvature),
            np.radians(self.climb_deg),
        )
        return np.asarray(start + rng.uniform(1.0, 1.0 + self.stretch) * way)


def curve_points(yaw: float, s: Array, curvature: Array, climb: Array) -> Array:
    """Points a metre apart of a curve from the origin, from its curvature and climb.

    d(yaw)/ds = curvature, d(x, y, z)/ds = (cos yaw, -sin yaw, tan climb), s the level way.

    Args:
        yaw: first course [rad].
        s: (k,) knots [m], from 0.
        curvature: (k,) positive to the right [1/m].
        climb: (k,) [rad].

    Returns:
        (n, 3) [m]; the first is the origin.
    """
    # Steps of 0.1 m: the course at the middle of each is what was turned before it and half of its
    # own turn.
    middle = np.arange(0.05, s[-1], 0.1)
    bend = np.interp(middle, s, curvature)
    course = yaw + 0.1 * (np.cumsum(bend) - 0.5 * bend)
    steps = 0.1 * np.column_stack(
        [np.cos(course), -np.sin(course), np.tan(np.interp(middle, s, climb))]
    )
    return np.concatenate([np.zeros((1, 3)), np.cumsum(steps, axis=0)])[::10]
