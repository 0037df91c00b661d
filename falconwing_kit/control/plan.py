"""Plans: start, curvature and climb -> the waypoints of a manoeuvre; the table of manoeuvres."""

import math
import zlib
from collections.abc import Callable, Iterable
from dataclasses import dataclass

import numpy as np

from falconwing_kit.core.checks import Array, InputError

MARGIN = 1.0  # of a leader to walls and beams [m]; its half span is 0.35 m
MIN_HEIGHT = 0.7  # above the floor [m]


@dataclass(frozen=True)
class Manoeuvre:
    """A flight that a leader can fly."""

    name: str
    summary: str  # as `fly --help` shows it
    waypoints: Callable[[np.random.Generator], Array]  # -> (n, 3) [m], about a metre apart
    frozen_number: int | None = None  # of the first five, whose flights are recorded; else None

    @property
    def number(self) -> int:
        """Part of the random generator's key; independent of all other manoeuvres."""
        return zlib.crc32(self.name.encode()) if self.frozen_number is None else self.frozen_number


def manoeuvre_table(manoeuvres: Iterable[Manoeuvre]) -> dict[str, Manoeuvre]:
    """Manoeuvres by name, in the order of their numbers; InputError where two share one."""
    table: dict[str, Manoeuvre] = {}
    for manoeuvre in sorted(manoeuvres, key=lambda one: one.number):
        for other in table.values():
            if manoeuvre.name == other.name or manoeuvre.number == other.number:
                raise InputError(
                    f"manoeuvre {manoeuvre.name}: expected a name and a number of its own, got"
                    f" those of {other.name} ({other.number}): choose another name"
                )
        table[manoeuvre.name] = manoeuvre
    return table


@dataclass(frozen=True)
class Plan:
    """A manoeuvre's start, curvature and climb, linear between the knots.

    The hall is 40 m long; the paper's manoeuvres begin 6.5 m from its end to leave room for a
    follower.
    """

    start: tuple[float, float, float]  # [m]
    yaw_deg: float
    s: tuple[float, ...]  # level arc length of the knots [m]
    curvature: tuple[float, ...]  # at the knots, positive to the right [1/m]
    climb_deg: tuple[float, ...]  # at the knots
    shift: tuple[float, float, float] = (0.5, 0.5, 0.2)  # largest random offset per axis [m]
    stretch: float = 0.05  # largest random enlargement, as a share

    def waypoints(self, rng: np.random.Generator) -> Array:
        """A point every metre (n, 3) [m], shifted and enlarged at random."""
        start = np.array(self.start) + rng.uniform(-1.0, 1.0, 3) * self.shift
        s, curvature, climb = np.array(self.s), np.array(self.curvature), np.radians(self.climb_deg)
        curve = curve_points(math.radians(self.yaw_deg), s, curvature, climb)
        return np.asarray(start + rng.uniform(1.0, 1.0 + self.stretch) * curve)


def curve_points(yaw: float, s: Array, curvature: Array, climb: Array) -> Array:
    """Points (n, 3) a metre apart [m] of a curve from the origin, from its curvature and climb.

    d(yaw)/ds = curvature, d(x, y, z)/ds = (cos yaw, -sin yaw, tan climb), s the level arc length.

    Args:
        yaw: first course [rad].
        s: (k,) knots [m], from 0.
        curvature: (k,) positive to the right [1/m].
        climb: (k,) [rad].
    """
    # Midpoint rule in steps of 0.1 m: the course at a midpoint is the sum of the turns of the steps
    # before it and half of its own.
    middle = np.arange(0.05, s[-1], 0.1)
    turn_rate = np.interp(middle, s, curvature)
    course = yaw + 0.1 * (np.cumsum(turn_rate) - 0.5 * turn_rate)
    steps = 0.1 * np.column_stack(
        [np.cos(course), -np.sin(course), np.tan(np.interp(middle, s, climb))]
    )
    return np.concatenate([np.zeros((1, 3)), np.cumsum(steps, axis=0)])[::10]
