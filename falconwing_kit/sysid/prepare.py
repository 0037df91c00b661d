"""Preparing: a flight table -> segments without gaps and outliers, and their noise, for a fit."""

import math
from dataclasses import dataclass, replace

import numpy as np

from falconwing_kit.core.checks import Array, InputError
from falconwing_kit.core.flight_table import (
    FlightTable,
    fill_missing_rows,
    interpolate_readings,
    nominal_rate_hz,
    select_rows,
    slice_time,
)
from falconwing_kit.core.frames import body_rates

CHANNELS = ("px", "py", "pz", "roll", "pitch", "yaw")  # order of all pose arrays here
MAX_RATE_HZ = 30.0  # rows of a fit; a faster log is thinned
LOCAL_SPAN_S = 0.6  # of one local cubic: short against a manoeuvre, 13 samples at 20 Hz
MIN_SAMPLES, MAX_SAMPLES = 5, 13  # in one local cubic
MIN_SEGMENT_S = 3.0  # shorter segments are dropped
OUTLIER_SIGMAS = 6.0  # one in 500 million samples of Gaussian noise lies beyond
LONGEST_GAP_S = 0.25  # commands are unknown in a longer gap: the flight is cut there
MIN_READINGS = 20  # of the sticks; fewer changes show no regular interval between them
SAME_INTERVAL = 0.2  # intervals within a row or this share of the usual one are alike
MIN_ALIKE, MAX_SHORTER = 0.7, 0.02  # shares of the intervals between readings
# Optional columns; better initial states than any derivative.
LOGGED_MOTION = ("vx", "vy", "vz", "p", "q", "r")
# Noise of these over that of the derivatives, above which they are not: 2.5 for gyroscopes of ALFA
# at 4 Hz, 3.7 and 10 for differences of poses at 10 and 20 Hz.
MAX_MOTION_NOISE = 3.0
MIN_NOISE = np.full(6, 1e-3)  # [m, rad]; a smaller estimate is not of measured poses


@dataclass(frozen=True)
class PreparedFlight:
    """A segment without gaps of a prepared flight, N rows about evenly spaced."""

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
    """A flight table ready for fitting."""

    flights: tuple[PreparedFlight, ...]
    sigma: Array  # (6,) [m, rad]
    outliers: int  # poses removed
    missing: int  # rows without a pose
    warnings: tuple[str, ...]


def prepare(table: FlightTable, sigma: Array | None = None) -> PreparedTable:
    """Make a flight table ready for fitting.

    0. Interpolate stick positions that were read less often than the poses; thin a log faster than
       30 Hz: every k-th pose, with the mean of the commands until the next.
    1. Cut it at gaps longer than 0.25 s, insert rows for single missing frames, unwrap angles.
    2. Fit a cubic robustly to the poses within 0.3 s of each row: state and derivatives.
    3. Estimate the noise of each channel from fourth differences.
    4. Remove poses more than six standard deviations from their cubic.

    Args:
        table: one flight as read.
        sigma: (6,) noise per channel [m, rad] if known; else the table's own columns, else
            estimated.

    Raises:
        InputError: fewer than 3 s of usable poses without a break.
    """
    table = thin_table(interpolate_slow_sticks(table))
    warnings = list(table.warnings)
    candidates = map(_smooth_segment, _split_at_gaps(table))
    segments = [segment for segment in candidates if segment is not None]
    if not segments:
        raise InputError(
            f"{table.name}: expected at least 3 s of poses without a break, found none; "
            f"{int(np.isnan(table.p_world[:, 0]).sum())} of {len(table.t)} rows have no pose"
        )
    estimated = np.sqrt(np.median([segment.variance for segment in segments], axis=0))
    measured = _measured_noise(table, sigma)
    noise = np.maximum(estimated if measured is None else measured, MIN_NOISE)
    flights, outliers = [], 0
    for number, segment in enumerate(segments):
        outlier = _find_outliers(segment.residual, np.maximum(noise, estimated))
        outliers += int(outlier.any(axis=1).sum())
        pose = np.where(outlier, np.nan, segment.pose)
        name = table.name if len(segments) == 1 else f"{table.name}#{number}"
        flights.append(
            PreparedFlight(
                name, segment.t, pose, segment.commands, noise, *_state_estimate(segment)
            )
        )
    missing = sum(int(np.isnan(segment.pose).all(axis=1).sum()) for segment in segments)
    rows = sum(len(segment.t) for segment in segments)
    if outliers > 0.05 * rows:
        warnings.append(
            f"{table.name}: {outliers} of {rows} poses are outliers; look at the video before"
            " trusting a fit"
        )
    return PreparedTable(tuple(flights), noise, outliers, missing, tuple(warnings))


def interpolate_slow_sticks(table: FlightTable) -> FlightTable:
    """The sticks on the lines between their readings, where these are rarer than the rows.

    Such a log repeats each reading until the next one, at regular intervals of two rows or more.
    Commands that are held on purpose change at no such interval and stay as they are.
    """
    moved = np.any(np.diff(table.commands, axis=0) != 0.0, axis=1)
    rows = np.append(0, np.flatnonzero(moved) + 1)
    intervals = np.diff(rows)
    if len(intervals) < MIN_READINGS:
        return table
    usual = int(np.bincount(intervals).argmax())
    alike = np.abs(intervals - usual) <= max(1.0, SAME_INTERVAL * usual)
    shorter = intervals < (1.0 - SAME_INTERVAL) * usual
    if usual < 2 or np.mean(alike) < MIN_ALIKE or np.mean(shorter) > MAX_SHORTER:
        return table
    commands = interpolate_readings(table.t, table.t[rows], table.commands[rows])
    return replace(table, commands=commands)


def thin_table(table: FlightTable, highest_hz: float = MAX_RATE_HZ) -> FlightTable:
    """Every k-th row of a fast log, each with the mean of the commands until the next one kept.

    Poses are not averaged. The aircraft's own motion is far slower, so a fit gains nothing from
    more rows but time.
    """
    k = math.ceil(nominal_rate_hz(table) / highest_hz - 0.05)
    if k < 2:
        return table
    # Time-weighted means of the commands, each of which acts until the next row.
    begins = np.arange(0, len(table.t), k)
    duration = np.append(np.diff(table.t), np.median(np.diff(table.t)))
    weights = np.add.reduceat(duration, begins)
    means = np.add.reduceat(table.commands * duration[:, None], begins) / weights[:, None]
    return replace(select_rows(table, begins), commands=means)


def _find_outliers(residual: Array, sigma: Array) -> Array:
    """Mask (N, 6) of residuals (N, 6) beyond six sigmas (6,); a position or attitude as a whole."""
    # Relative to a running median too: the slow misfit of the cubic itself is no outlier.
    isolated = residual - _running_median(residual)
    bad = np.minimum(np.abs(residual), np.abs(isolated)) > OUTLIER_SIGMAS * sigma
    halves = np.stack([bad[:, :3].any(axis=1), bad[:, 3:].any(axis=1)], axis=1)
    return np.repeat(halves, 3, axis=1)


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
    slope_variance: Array  # (6,) of the cubics' slopes, from that noise


def _split_at_gaps(table: FlightTable) -> list[FlightTable]:
    """Cut at gaps longer than LONGEST_GAP_S; keep segments of at least 3 s."""
    longest = max(LONGEST_GAP_S, 2.5 / nominal_rate_hz(table))
    cuts = np.flatnonzero(np.diff(table.t) > longest)
    begins, ends = np.concatenate([[0], cuts + 1]), np.concatenate([cuts, [len(table.t) - 1]])
    spans = [
        (table.t[a], table.t[b])
        for a, b in zip(begins, ends, strict=True)
        if table.t[b] - table.t[a] >= MIN_SEGMENT_S
    ]
    return [fill_missing_rows(slice_time(table, a, b + 1e-9)) for a, b in spans]


def _smooth_segment(table: FlightTable) -> _Segment | None:
    """Local cubics through positions and attitudes; None where too few poses are measured."""
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
    variance, slope_variance = (np.concatenate([f[k] for f in fits]) for k in (4, 5))
    pose = _rewrap(pose, value)
    unknown = np.full(len(table.t), np.nan)
    logged = np.stack([table.extra.get(name, unknown) for name in LOGGED_MOTION], axis=1)
    return _Segment(
        table.t, pose, table.commands, value, slope, curvature, residual, logged, variance,
        slope_variance,
    )  # fmt: skip


def _rewrap(pose: Array, value: Array) -> Array:
    """Shift angles by whole turns towards their local estimate: unwrapping fails at outliers."""
    turns = np.zeros_like(pose)
    turns[:, 3:] = np.round((pose[:, 3:] - value[:, 3:]) / (2.0 * np.pi))
    return np.asarray(pose - 2.0 * np.pi * np.nan_to_num(turns))


def _local_cubics(t: Array, y: Array, measured: Array) -> tuple[Array, ...]:
    """A robust cubic around every row through its nearest measured samples.

    Args:
        t: (N,) [s].
        y: (N, 3) positions or attitudes.
        measured: (N,) mask of measured rows.

    Returns:
        value, slope, curvature, residual, each (N, 3), the noise variance (3,), and that of slopes.
    """
    ts, ys = t[measured], y[measured]
    interval = max(float(np.median(np.diff(ts))), 1e-6)
    half = int(np.clip(round(LOCAL_SPAN_S / interval), MIN_SAMPLES - 1, MAX_SAMPLES - 1)) // 2
    half = min(half, (len(ts) - 1) // 2)
    # Indices (N, 13) of the nearest samples, their scaled times and the cubic's basis there.
    centre = np.clip(np.searchsorted(ts, t), half, len(ts) - half - 1)
    near = centre[:, None] + np.arange(-half, half + 1)
    scale = interval * half
    s = (ts[near] - t[:, None]) / scale
    basis = np.stack([np.ones_like(s), s, s**2, s**3], axis=-1)  # (N, 13, 4)
    samples = ys[near]
    # An outlier at the end of a cubic's span has the most leverage, so the first weights come from
    # fourth differences, which show it by itself.
    jump = np.zeros_like(ys)
    jump[2:-2] = np.diff(ys, 4, axis=0) / (np.sqrt(70.0) * np.maximum(difference_noise(ys), 1e-9))
    weights = (1.0 / (1.0 + (jump / 6.0) ** 2) ** 2)[near]
    for _ in range(4):
        # Iteratively reweighted least squares, Geman-McClure weights per row and channel.
        normal = np.einsum("nsi,nsj,nsc->ncij", basis, basis, weights, optimize=True)
        right = np.einsum("nsi,nsc,nsc->nci", basis, weights, samples, optimize=True)
        coefficients = np.linalg.solve(normal + 1e-9 * np.eye(4), right[..., None])[..., 0]
        errors = samples - np.einsum("nsi,nci->nsc", basis, coefficients)
        local = np.maximum(1.483 * np.median(np.abs(errors), axis=1, keepdims=True), 1e-6)
        overall = np.maximum(1.483 * np.median(np.abs(errors)[:, half], axis=0), 1e-6)
        weights = 1.0 / (1.0 + (errors / (3.0 * np.maximum(local, overall))) ** 2) ** 2
    value, slope, curvature = (
        coefficients[..., k] * f / scale**k for k, f in ((0, 1.0), (1, 1.0), (2, 2.0))
    )
    residual = np.where(measured[:, None], y - value, 0.0)
    variance, middle = difference_noise(ys) ** 2, basis[len(basis) // 2]
    of_slope = np.linalg.inv(middle.T @ middle + 1e-9 * np.eye(4))[1, 1] / scale**2
    slope_variance = of_slope * np.maximum(variance, MIN_NOISE[:3] ** 2)
    return value, slope, curvature, residual, variance, slope_variance


def _running_median(values: Array) -> Array:
    """Median of five neighbouring rows, (N, C) -> (N, C)."""
    padded = np.concatenate([values[:2], values, values[-2:]])
    windows = np.lib.stride_tricks.sliding_window_view(padded, 5, axis=0)
    return np.asarray(np.median(windows, axis=-1))


def difference_noise(samples: Array) -> Array:
    """Robust standard deviation (C,) of the white noise of samples, from fourth differences.

    A smooth flight hardly affects them: the sum of squares of (1, -4, 6, -4, 1) is 70, and of a
    motion at 10 rad/s sampled at 20 Hz 6 % of its amplitude remain. Noise that is correlated over
    many samples is not included.

    Args:
        samples: (N, C) evenly spaced, N >= 5.
    """
    fourth = np.diff(samples, 4, axis=0)
    return np.asarray(1.4826 * np.median(np.abs(fourth), axis=0) / np.sqrt(70.0))


def _measured_noise(table: FlightTable, sigma: Array | None) -> Array | None:
    """Known noise (6,): as given, else of the table's columns; None where neither is there."""
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
    """State (N, 12) and its time derivative from the local cubics.

    Logged velocities and body rates go first, unless they are far noisier than the cubics' slopes,
    as differences of poses are.
    """
    p_world, angles = segment.value[:, :3], segment.value[:, 3:]  # roll, pitch, yaw
    v_world, angle_rates = segment.slope[:, :3], segment.slope[:, 3:]
    rates = np.stack(body_rates(angles[:, 0], angles[:, 1], *angle_rates.T), axis=1)
    # Angular acceleration as a difference of the body rates over a millisecond.
    dt = 1e-3
    later, later_rates = angles + dt * angle_rates, angle_rates + dt * segment.curvature[:, 3:]
    rates_later = np.stack(body_rates(later[:, 0], later[:, 1], *later_rates.T), axis=1)
    order = [1, 2, 0]  # roll, pitch, yaw -> pitch, yaw, roll
    state = np.concatenate([p_world, angles[:, order], v_world, rates], axis=1)
    for k, (logged, variance) in enumerate(
        zip(segment.logged.T, segment.slope_variance, strict=True)
    ):
        known = np.isfinite(logged)
        if known.sum() < MIN_SAMPLES:
            continue
        noise = difference_noise((logged - state[:, 6 + k])[known, None])[0]  # motion cancels
        if noise <= MAX_MOTION_NOISE * np.sqrt(variance):
            state[known, 6 + k] = logged[known]
    derivatives = [v_world, angle_rates[:, order], segment.curvature[:, :3]]
    return state, np.concatenate([*derivatives, (rates_later - rates) / dt], axis=1)
