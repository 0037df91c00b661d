"""Guidance: points in the hall -> a smooth path, and where the aircraft is along it -> the
reference to hold.
"""

import math
from dataclasses import dataclass

import numpy as np

from falconwing_kit.control.loops import Reference
from falconwing_kit.core.checks import Array, InputError, require_shape
from falconwing_kit.core.frames import GRAVITY

SPACING = 0.1  # m between the samples of a path
CLIMB_LIMIT = math.radians(
    12.0
)  # of a planned path; at half throttle the aircraft climbs by 10 deg
# bank and climb are those of the path so far ahead: delay, servo and the aircraft's own answer
PREVIEW_S = 0.2


@dataclass(frozen=True)
class Hall:
    """The hall's inner walls [m], in the world: 40 x 20 x 5 m around the marker and pad."""

    x: tuple[float, float] = (-22.5, 17.5)
    y: tuple[float, float] = (-12.0, 8.0)
    height: float = 5.0
    beams: float = 4.65  # their underside; whoever flies above it hits one sooner or later

    def margin(self, p_world: Array) -> Array:
        """How far points are from the nearest wall or the beams under the ceiling; negative
        outside.

        Args:
            p_world: (..., 3) [m].

        Returns:
            (...) [m].
        """
        p = np.asarray(p_world, np.float64)
        sides = (
            p[..., 0] - self.x[0],
            self.x[1] - p[..., 0],
            p[..., 1] - self.y[0],
            self.y[1] - p[..., 1],
        )
        return np.minimum.reduce([*sides, self.beams - p[..., 2]])

    def inside(self, p_world: Array, margin: float) -> Array:
        """The nearest points that keep a margin from walls, beams and floor.

        Args:
            p_world: (..., 3) [m].
            margin: [m].

        Returns:
            (..., 3) [m].
        """
        low, high = (np.array([self.x[i], self.y[i], (0.0, self.beams)[i]]) for i in range(2))
        return np.clip(p_world, low + margin, high - margin)


class ReferencePath:
    """A smooth curve through points, sampled by its length; straight on beyond its ends."""

    def __init__(self, p_world: Array) -> None:
        """Lay a cubic spline through points (n, 3) [m]; InputError where there is no such curve."""
        from scipy.interpolate import CubicSpline

        points = require_shape("path points", p_world, (None, 3))
        steps = np.linalg.norm(np.diff(points, axis=0), axis=1)
        if len(points) < 2 or not np.isfinite(points).all() or steps.min() < 1e-3:
            raise InputError(
                "path: expected two or more different, finite points; remove repeated ones"
            )
        chord = np.concatenate([[0.0], np.cumsum(steps)])
        curve = CubicSpline(chord, points, bc_type="not-a-knot")
        fine = np.linspace(0.0, chord[-1], max(int(chord[-1] / 0.01), 2))
        length = np.concatenate(
            [[0.0], np.cumsum(np.linalg.norm(np.diff(curve(fine), axis=0), axis=1))]
        )
        self.s = np.linspace(0.0, length[-1], max(round(length[-1] / SPACING), 1) + 1)
        u = np.interp(self.s, length, fine)
        d1, d2 = curve(u, 1), curve(u, 2)
        level = np.maximum(np.hypot(d1[:, 0], d1[:, 1]), 1e-9)
        self.p_world = curve(u)
        self.yaw = np.unwrap(np.arctan2(-d1[:, 1], d1[:, 0]))
        self.climb = np.arctan2(d1[:, 2], level)
        # Turn per metre of level way, positive to the right.
        self.curvature = (d1[:, 1] * d2[:, 0] - d1[:, 0] * d2[:, 1]) / level**3

    @property
    def length(self) -> float:
        """[m]."""
        return float(self.s[-1])

    def nearest(self, p_world: Array, near: float | None = None) -> float:
        """Where along the path a point is; only 3 m around `near` are looked at, so that crossings
        do not confuse.

        Args:
            p_world: (3,) [m].
            near: where it was last [m]; None looks at the whole path.

        Returns:
            Length from the path's first point [m]; negative before it, beyond the length after its
            end.
        """
        near_enough = slice(None) if near is None else self._window(near)
        level = self.p_world[near_enough, :2] - p_world[:2]
        i = int(np.argmin(np.einsum("ij,ij->i", level, level))) + (near_enough.start or 0)
        ahead = np.array([math.cos(self.yaw[i]), -math.sin(self.yaw[i])])
        beyond = float((p_world[:2] - self.p_world[i, :2]) @ ahead) / max(
            math.cos(self.climb[i]), 0.1
        )
        inner = 0 < i < len(self.s) - 1
        return float(self.s[i]) + (min(max(beyond, -SPACING), SPACING) if inner else beyond)

    def _window(self, near: float) -> slice:
        spacing = self.length / (len(self.s) - 1)
        middle = min(max(round(near / spacing), 0), len(self.s) - 1)
        return slice(max(middle - round(3.0 / spacing), 0), middle + round(3.0 / spacing) + 1)

    def at(self, s: float, speed: float) -> Reference:
        """The reference at a place of the path.

        The bank is that of a coordinated turn, tan(bank) = V^2 cos(climb)^2 curvature / g [Beard &
        McLain, Small Unmanned Aircraft, eq. 9.14 with yaw rate = V cos(climb) curvature].

        Args:
            s: length from the first point [m]; straight on before 0 and beyond the end.
            speed: to fly there [m/s].

        Returns:
            The reference.
        """
        inside = min(max(s, 0.0), self.length)
        yaw, slope = (
            float(np.interp(inside, self.s, self.yaw)),
            float(np.interp(inside, self.s, self.climb)),
        )
        p = np.array([np.interp(inside, self.s, self.p_world[:, axis]) for axis in range(3)])
        along = np.array(
            [math.cos(yaw) * math.cos(slope), -math.sin(yaw) * math.cos(slope), math.sin(slope)]
        )
        ahead = s + speed * PREVIEW_S
        climb = float(np.interp(ahead, self.s, self.climb))
        curvature = float(np.interp(ahead, self.s, self.curvature, left=0.0, right=0.0))
        bank = math.atan((speed * math.cos(climb)) ** 2 * curvature / GRAVITY)
        return Reference(p + (s - inside) * along, yaw, climb, speed, bank)


def require_flyable(path: ReferencePath, speed: float, bank_limit: float) -> None:
    """Raise InputError where a path turns tighter or climbs steeper than the aircraft should.

    Args:
        path: the path.
        speed: to fly it [m/s].
        bank_limit: of a planned turn [rad].

    Raises:
        InputError: the text says where, how much, and the limit.
    """
    bank = np.arctan((speed * np.cos(path.climb)) ** 2 * path.curvature / GRAVITY)
    for what, angle, limit in (("bank", bank, bank_limit), ("climb", path.climb, CLIMB_LIMIT)):
        worst = int(np.argmax(np.abs(angle)))
        if abs(angle[worst]) > limit + 1e-9:
            x, y, z = path.p_world[worst]
            raise InputError(
                f"waypoints: expected at most {math.degrees(limit):.0f} deg of {what}, the path needs "
                f"{math.degrees(abs(angle[worst])):.0f} deg at ({x:.1f}, {y:.1f}, {z:.1f}) m; lay them wider or flatter"
            )
