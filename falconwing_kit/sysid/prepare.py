"""Preparing a flight: a flight table -> rows a fit can use, with outliers set aside, noise known
and gaps as gaps.
"""

from dataclasses import dataclass

import numpy as np

from falconwing_kit.core.checks import Array, InputError
from falconwing_kit.core.flight_table import (
    FlightTable,
    fill_missing_rows,
    nominal_rate_hz,
    slice_time,
)
from falconwing_kit.core.frames import body_rates

CHANNELS = ("px", "py", "pz", "roll", "pitch", "yaw")  # order of every pose array in this room
LOCAL_SPAN_S = 0.6  # of one local cubic: short against a manoeuvre, 13 samples at 20 Hz
MIN_SAMPLES, MAX_SAMPLES = 5, 13  # in one local cubic
OUTLIER_SIGMAS = 6.0  # beyond this a pose is not noise; with Gaussian noise one in 500 million
LONGEST_GAP_S = 0.25  # commands are unknown in a longer gap: the flight is cut there
LOGGED_MOTION = (
    "vx",
    "vy",
    "vz",
    "p",
    "q",
    "r",
)  # optional columns; better start states than any derivative
MIN_NOISE = np.array(
    [1e-3, 1e-3, 1e-3, 1e-3, 1e-3, 1e-3]
)  # m, rad: below this a pose is not measured but computed


@dataclass(frozen=True)
class PreparedFlight:
    """One unbroken stretch of a prepared flight, N rows about evenly spaced."""

    name: str
    t: Array  # (N,) [s]
    pose: Array  # (N, 6) in the order of CHANNELS [m, rad], yaw unwrapped, nan where unusable
    commands: Array  # (N, 4)
    sigma: Array  # (6,) noise of each channel [m, rad]
    state_estimate: Array  # (N, 12) local estimate of the state, order of STATE_NAMES, SI
    state_derivatives: Array  # (N, 12) its time derivative

    @property
    def duration(self) -> float:
        """Time from first to last row [s]."""
        return float(self.t[-1] - self.t[0])


@dataclass(frozen=True)
class PreparedTable:
    """A flight table made ready for fitting."""

    flights: tuple[PreparedFlight, ...]
    sigma: Array  # (6,) [m, rad]
    outliers: int  # poses set aside
    missing: int  # rows without a pose
    warnings: tuple[str, ...]


def prepare(table: FlightTable, sigma: Array | None = None) -> PreparedTable:
    """Make a flight table ready for fitting.

    Steps: cut at gaps longer than 0.25 s, put empty rows where single frames are missing, unwrap
        the angles, fit a
    cubic to the poses within 0.3 s of each row (robustly), set poses aside that lie six standard
    deviations off it, and estimate the noise of each channel from fourth differences.

    Args:
        table: one flight as read.
        sigma: (6,) noise per channel [m, rad] where it is known; else the table's own columns, else
            estimated.

    Returns:
        The stretches of the flight and what was done to them.

    Raises:
        InputError: fewer than 3 s of usable poses in a row.
    """
    warnings = list(table.warnings)
    segments = [
        segment for segment in map(_smooth_segment, _split_at_gaps(table)) if segment is not None
    ]
    if not segments:
        raise InputError(
            f"{table.name}: expected at least 3 s of poses without a break, found none; "
            f"{int(np.isnan(table.p_world[:, 0]).sum())} of {len(table.t)} rows have no pose"
        )
    noise = _measured_noise(table, sigma)
    estimated = np.sqrt(np.median([segment.variance for segment in segments], axis=0))
    noise = np.maximum(estimated if noise is None else noise, MIN_NOISE)
    outliers = 0
    flights = []
    for number, segment in enumerate(segments):
        isolated = segment.residual - _running_median(
            segment.residual
        )  # the cubic's own slow misfit is no outlier
        bad = np.minimum(np.abs(segment.residual), np.abs(isolated)) > OUTLIER_SIGMAS * np.maximum(
            noise, estimated
        )
        bad_rows = np.stack([bad[:, :3].any(axis=1), bad[:, 3:].any(axis=1)], axis=1)
        outliers += int(bad_rows.any(axis=1).sum())
        pose = np.where(np.repeat(bad_rows, 3, axis=1), np.nan, segment.pose)
        name = table.name if len(segments) == 1 else f"{table.name}#{number}"
        state_estimate, state_derivatives = _state_estimate(segment)
        flights.append(
            PreparedFlight(
                name, segment.t, pose, segment.commands, noise, state_estimate, state_derivatives
            )
        )
    missing = sum(int(np.isnan(segment.pose).all(axis=1).sum()) for segment in segments)
    rows = sum(len(segment.t) for segment in segments)
    if outliers > 0.05 * rows:
        warnings.append(
            f"{table.name}: {outliers} of {rows} poses are outliers; look at the video before trusting a fit"
        )
    return PreparedTable(tuple(flights), noise, outliers, missing, tuple(warnings))


@dataclass(frozen=True)
class _Segment:
    t: Array
    pose: Array  # (N, 6), unwrapped
    commands: Array
    value: Array  # (N, 6) local cubics at each row
    slope: Array
    curvature: Array
    residual: Array  # (N, 6) pose minus cubic, zero where no pose
    logged: Array  # (N, 6) velocity and body rates where the log has them, else nan
    variance: Array  # (6,) of the noise


def _split_at_gaps(table: FlightTable) -> list[FlightTable]:
    """Cut where no row came for longer than LONGEST_GAP_S; keep stretches of at least 3 s."""
    longest = max(LONGEST_GAP_S, 2.5 / nominal_rate_hz(table))
    cuts = np.flatnonzero(np.diff(table.t) > longest)
    begins, ends = np.concatenate([[0], cuts + 1]), np.concatenate([cuts, [len(table.t) - 1]])
    spans = [
        (table.t[a], table.t[b])
        for a, b in zip(begins, ends, strict=True)
        if table.t[b] - table.t[a] >= 3.0
    ]
    return [fill_missing_rows(slice_time(table, a, b + 1e-9)) for a, b in spans]


def _smooth_segment(table: FlightTable) -> _Segment | None:
    """Local cubics through positions and attitudes; None where there are too few poses."""
    pose = np.concatenate([table.p_world, table.attitude], axis=1)
    for channel in range(3, 6):
        measured = np.isfinite(pose[:, channel])
        pose[measured, channel] = np.unwrap(pose[measured, channel])
    fits = []
    for columns in (slice(0, 3), slice(3, 6)):
        measured = np.isfinite(pose[:, columns]).all(axis=1)
        if measured.sum() < 2 * MIN_SAMPLES:
            return None
        fits.append(_local_cubics(table.t, pose[:, columns], measured))
    value, slope, curvature, residual = (
        np.concatenate(parts, axis=1) for parts in zip(*[f[:4] for f in fits], strict=True)
    )
    variance = np.concatenate([f[4] for f in fits])
    pose = _rewrap(pose, value)
    logged = np.stack(
        [table.extra.get(k, np.full(len(table.t), np.nan)) for k in LOGGED_MOTION], axis=1
    )
    return _Segment(
        table.t, pose, table.commands, value, slope, curvature, residual, logged, variance
    )


def _rewrap(pose: Array, value: Array) -> Array:
    """Move angles by whole turns to the side of their local estimate; an outlier may have led
    unwrapping astray.
    """
    turns = np.zeros_like(pose)
    turns[:, 3:] = np.round((pose[:, 3:] - value[:, 3:]) / (2.0 * np.pi))
    return np.asarray(pose - 2.0 * np.pi * np.nan_to_num(turns))


def _local_cubics(t: Array, y: Array, measured: Array) -> tuple[Array, Array, Array, Array, Array]:
    """A robust cubic around every row through its nearest measured samples.

    Args:
        t: (N,) [s].
        y: (N, 3) one pose half.
        seen: (N,) which rows are measured.

    Returns:
        value, slope, curvature, residual, each (N, 3), and the noise variance (3,) corrected for
        the fit's freedom.
    """
    ts, ys = t[measured], y[measured]
    interval = max(float(np.median(np.diff(ts))), 1e-6)
    half = int(np.clip(round(LOCAL_SPAN_S / interval), MIN_SAMPLES - 1, MAX_SAMPLES - 1)) // 2
    half = min(half, (len(ts) - 1) // 2)
    centre = np.clip(np.searchsorted(ts, t), half, len(ts) - half - 1)
    near = centre[:, None] + np.arange(-half, half + 1)
    scale = interval * half
    s = (ts[near] - t[:, None]) / scale
    basis = np.stack([np.ones_like(s), s, s**2, s**3], axis=-1)  # (N, 13, 4)
    samples = ys[near]
    # An outlier at the end of a cubic's span pulls hardest: begin with what fourth differences say
    # of each sample.
    jump = np.zeros_like(ys)
    jump[2:-2] = np.diff(ys, 4, axis=0) / (np.sqrt(70.0) * np.maximum(difference_noise(ys), 1e-9))
    weights = (1.0 / (1.0 + (jump / 6.0) ** 2) ** 2)[near]
    for _ in range(4):
        normal = np.einsum("nsi,nsj,nsc->ncij", basis, basis, weights, optimize=True)
        right = np.einsum("nsi,nsc,nsc->nci", basis, weights, samples, optimize=True)
        coefficients = np.linalg.solve(normal + 1e-9 * np.eye(4), right[..., None])[..., 0]
        left = samples - np.einsum("nsi,nci->nsc", basis, coefficients)
        spread = np.maximum(1.483 * np.median(np.abs(left), axis=1, keepdims=True), 1e-6)
        overall = np.maximum(1.483 * np.median(np.abs(left)[:, half], axis=0), 1e-6)
        weights = 1.0 / (1.0 + (left / (3.0 * np.maximum(spread, overall))) ** 2) ** 2
    value, slope, curvature = (
        coefficients[..., k] * f / scale**k for k, f in ((0, 1.0), (1, 1.0), (2, 2.0))
    )
    return (
        value,
        slope,
        curvature,
        np.where(measured[:, None], y - value, 0.0),
        difference_noise(ys) ** 2,
    )


def _running_median(values: Array) -> Array:
    """Median of five neighbouring rows, (N, C) -> (N, C)."""
    padded = np.concatenate([values[:2], values, values[-2:]])
    return np.asarray(
        np.median(np.lib.stride_tricks.sliding_window_view(padded, 5, axis=0), axis=-1)
    )


def difference_noise(samples: Array) -> Array:
    """Standard deviation of the noise from fourth differences, which a smooth flight hardly
    touches.

    Sum of squares of (1, -4, 6, -4, 1) is 70; a motion at 10 rad/s sampled at 20 Hz keeps 6 % of
    its amplitude. Noise that is correlated over many samples is not seen: this is the white part.

    Args:
        samples: (N, C) evenly spaced, N >= 5.

    Returns:
        (C,) robust standard deviation, same unit.
    """
    fourth = np.diff(samples, 4, axis=0)
    return np.asarray(1.4826 * np.median(np.abs(fourth), axis=0) / np.sqrt(70.0))


def _measured_noise(table: FlightTable, sigma: Array | None) -> Array | None:
    if sigma is not None:
        return np.asarray(sigma, np.float64)
    if "sigma_position" not in table.extra or "sigma_attitude" not in table.extra:
        return None
    logged = [table.extra[name] for name in ("sigma_position", "sigma_attitude")]
    if any(np.isnan(values).all() for values in logged):
        return None
    position, attitude = (float(np.nanmedian(values)) for values in logged)
    return np.array([position] * 3 + [attitude] * 3)


def _state_estimate(segment: _Segment) -> tuple[Array, Array]:
    """State and its time derivative at every row, from the local cubics."""
    roll, pitch = segment.value[:, 3], segment.value[:, 4]
    rates = np.stack(body_rates(roll, pitch, *segment.slope[:, 3:].T), axis=1)
    ahead = 1e-3
    later = segment.value[:, 3:] + ahead * segment.slope[:, 3:]
    later_slope = segment.slope[:, 3:] + ahead * segment.curvature[:, 3:]
    rates_ahead = np.stack(body_rates(later[:, 0], later[:, 1], *later_slope.T), axis=1)
    order = [1, 2, 0]  # roll, pitch, yaw -> pitch, yaw, roll
    state_estimate = np.concatenate(
        [segment.value[:, :3], segment.value[:, 3:][:, order], segment.slope[:, :3], rates], axis=1
    )
    state_estimate[:, 6:] = np.where(
        np.isfinite(segment.logged), segment.logged, state_estimate[:, 6:]
    )
    state_derivatives = np.concatenate(
        [
            segment.slope[:, :3],
            segment.slope[:, 3:][:, order],
            segment.curvature[:, :3],
            (rates_ahead - rates) / ahead,
        ],
        axis=1,
    )
    return state_estimate, state_derivatives
