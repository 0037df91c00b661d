"""Guidance: waypoints in the hall -> a smooth path, a place along it -> the reference there;
whether the path can be flown.
"""

import math
from dataclasses import dataclass

import numpy as np

from falconwing_kit.control.loops import Reference
from falconwing_kit.core.checks import Array, InputError, require_shape
from falconwing_kit.core.frames import GRAVITY, HALL_HIGH, HALL_LOW

SPACING = 0.1  # between the samples of a path [m]
MIN_STEP = 1e-3  # between points that a path leads through [m]; nearer ones are the same
MIN_LEVEL = 1e-9  # share of a direction that is level: a vertical path has no course
ANGLE_TOLERANCE = 1e-9  # of rounding, in the check of bank and climb [rad]
SEARCH = 3.0  # either side of the last nearest point [m]; beyond it a path may cross itself
CLIMB_LIMIT = math.radians(12.0)  # of a planned path; at half throttle it climbs by 10 deg
# Bank and climb are those of the path so far ahead: link delay, servo and roll response.
PREVIEW_S = 0.2


@dataclass(frozen=True)
class Hall:
    """The hall's inner walls [m], in the world: 40 x 20 x 5 m around the marker and pad."""

    x: tuple[float, float] = (float(HALL_LOW[0]), float(HALL_HIGH[0]))
    y: tuple[float, float] = (float(HALL_LOW[1]), float(HALL_HIGH[1]))
    height: float = float(HALL_HIGH[2])
    beams: float = 4.65  # height of their underside, the usable ceiling

    def margin(self, p_world: Array) -> Array:
        """Distance (...) from points (..., 3) to the nearest wall or beam [m]; negative outside."""
        p = np.asarray(p_world, np.float64)
        x, y, z = p[..., 0], p[..., 1], p[..., 2]
        sides = (x - self.x[0], self.x[1] - x, y - self.y[0], self.y[1] - y)
        return np.minimum.reduce([*sides, self.beams - z])

    def clamp(self, p_world: Array, margin: float) -> Array:
        """The nearest points (..., 3) with at least a margin [m] to walls, beams and floor."""
        low, high = (np.array([self.x[i], self.y[i], (0.0, self.beams)[i]]) for i in range(2))
        return np.clip(p_world, low + margin, high - margin)


class ReferencePath:
    """A smooth curve through points, sampled by arc length; straight beyond its ends."""

    def __init__(self, p_world: Array) -> None:
        """Fit a cubic spline through points (n, 3) [m].

        Raises:
            InputError: fewer than two points, repeated ones, or one that is not finite.
        """
        from scipy.interpolate import CubicSpline

        points = require_shape("path points", p_world, (None, 3))
        steps = np.linalg.norm(np.diff(points, axis=0), axis=1)
        if len(points) < 2 or not np.isfinite(points).all() or steps.min() < MIN_STEP:
            raise InputError(
                "path: expected two or more different, finite points; remove repeated ones"
            )
        chord = np.concatenate([[0.0], np.cumsum(steps)])
        curve = CubicSpline(chord, points, bc_type="not-a-knot")
        # From the spline's parameter (chord length) to arc length, summed over steps of 1 cm.
        fine = np.linspace(0.0, chord[-1], max(int(chord[-1] / 0.01), 2))
        pieces = np.linalg.norm(np.diff(curve(fine), axis=0), axis=1)
        length = np.concatenate([[0.0], np.cumsum(pieces)])
        self.s = np.linspace(0.0, length[-1], max(round(length[-1] / SPACING), 1) + 1)
        u = np.interp(self.s, length, fine)
        d1, d2 = curve(u, 1), curve(u, 2)
        level = np.maximum(np.hypot(d1[:, 0], d1[:, 1]), MIN_LEVEL)
        self.p_world = curve(u)
        self.yaw = np.unwrap(np.arctan2(-d1[:, 1], d1[:, 0]))
        self.climb = np.arctan2(d1[:, 2], level)
        # Curvature of the ground track, positive to the right.
        self.curvature = (d1[:, 1] * d2[:, 0] - d1[:, 0] * d2[:, 1]) / level**3

    @property
    def length(self) -> float:
        """Arc length [m]."""
        return float(self.s[-1])

    def nearest(self, p_world: Array, near: float | None = None) -> float:
        """Arc length of the path's point nearest to a point, seen from above.

        Args:
            p_world: (3,) [m].
            near: the last result [m]: only 3 m to each side are searched. None searches everywhere.

        Returns:
            Arc length [m]; negative before the first point, above `length` after the last.
        """
        searched = slice(None) if near is None else self._window(near)
        level = self.p_world[searched, :2] - p_world[:2]
        i = int(np.argmin(np.einsum("ij,ij->i", level, level))) + (searched.start or 0)
        ahead = np.array([math.cos(self.yaw[i]), -math.sin(self.yaw[i])])
        # Projection on the tangent refines the sample; at an end it extends the path.
        along = float((p_world[:2] - self.p_world[i, :2]) @ ahead) / max(
            math.cos(self.climb[i]), 0.1
        )
        is_inner_sample = 0 < i < len(self.s) - 1
        if is_inner_sample:
            along = min(max(along, -SPACING), SPACING)
        return float(self.s[i]) + along

    def _window(self, near: float) -> slice:
        """The samples within SEARCH of an arc length [m]."""
        spacing = self.length / (len(self.s) - 1)
        middle = min(max(round(near / spacing), 0), len(self.s) - 1)
        half = round(SEARCH / spacing)
        return slice(max(middle - half, 0), middle + half + 1)

    def at(self, s: float, speed: float) -> Reference:
        """The reference at arc length s [m], to be flown at a speed [m/s].

        The bank is that of a coordinated turn, tan(bank) = V^2 cos(climb)^2 curvature / g [Beard &
        McLain, Small Unmanned Aircraft, eq. 9.14 with yaw rate = V cos(climb) curvature].
        """
        inside = min(max(s, 0.0), self.length)
        yaw = float(np.interp(inside, self.s, self.yaw))
        slope = float(np.interp(inside, self.s, self.climb))
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
    """Check the bank and climb that a path requires at a speed [m/s].

    Raises:
        InputError: it exceeds bank_limit [rad] or 12 deg of climb; the text gives place and angle.
    """
    bank = np.arctan((speed * np.cos(path.climb)) ** 2 * path.curvature / GRAVITY)
    for what, path_angle, limit in (("bank", bank, bank_limit), ("climb", path.climb, CLIMB_LIMIT)):
        worst = int(np.argmax(np.abs(path_angle)))
        largest = abs(path_angle[worst])
        if largest > limit + ANGLE_TOLERANCE:
            x, y, z = path.p_world[worst]
            raise InputError(
                f"waypoints: expected at most {math.degrees(limit):.0f} deg of {what}, the path "
                f"requires {math.degrees(largest):.0f} deg at ({x:.1f}, {y:.1f}, {z:.1f})"
                " m; place them wider apart or flatter"
            )
