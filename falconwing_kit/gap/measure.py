"""Measuring the gap: a flight replayed in a model -> residuals, and their excess by variable."""

from dataclasses import dataclass

import numpy as np

from falconwing_kit.aircraft.model import Model
from falconwing_kit.core.checks import Array
from falconwing_kit.core.flight_table import nearest_index
from falconwing_kit.gap.baseline import NominalModel
from falconwing_kit.gap.name import Naming
from falconwing_kit.sysid.prepare import CHANNELS, PreparedFlight
from falconwing_kit.sysid.score import score
from falconwing_kit.sysid.shooting import Windows

VARIABLES: dict[str, str] = {  # flight variables that a residual may depend on, and their units
    "time": "s", "x": "m", "y": "m", "height": "m", "speed": "m/s", "climb": "m/s",
    "heading": "rad", "bank": "rad",
    "throttle": "-", "aileron": "-", "elevator": "-", "rudder": "-",
}  # fmt: skip
BINS = 6
MIN_WINDOWS = 8  # in a bin; fewer give no estimate of the scatter
INPUT_AVERAGING_S = 1.0  # a control input acts on the pose with delay: its mean over this time
FALSE_ALARM_PROBABILITY = 0.01  # that a baseline flight has any significant bin
MAX_RESIDUAL_BINS = 12


@dataclass(frozen=True)
class FlightReplay:
    """Predictions of a flight by a model, two seconds at a time from estimated initial states."""

    t: Array  # (W, L) since the start of the flight [s]
    residual: Array  # (W, L, 6) predicted minus measured [sigma], nan where not measured
    variables: dict[str, Array]  # (W, L) each, the keys of VARIABLES


@dataclass(frozen=True)
class ResidualProfile:
    """Mean square residual of one channel in B bins of one variable, nan where too few rows."""

    edges: Array  # (B + 1,) in the variable's unit
    flight: Array  # (B,) [sigma^2]
    calm: Array  # (B,) the baseline's in the same bin, or its mean where it has no data there
    error: Array  # (B,) standard deviation of the difference where nothing is changed

    @property
    def excess_chi2(self) -> Array:
        """(B,) flight minus baseline [sigma^2]."""
        return self.flight - self.calm


@dataclass(frozen=True)
class ResidualBin:
    """A range of a variable in which one channel's residual exceeds the baseline's."""

    channel: str
    variable: str
    low: float
    high: float
    excess_chi2: float  # mean square above the baseline's [sigma^2]
    contrast: float  # the same above the rest of the flight, less two standard errors


def replay(model: Model, windows: Windows, initial_states: Array | None = None) -> FlightReplay:
    """Predict a flight's windows by a model with fixed parameters.

    Args:
        model: the aircraft.
        windows: W windows without whitening, weighted by the noise alone.
        initial_states: (W, n_states) first guess, or None for the windows' own.
    """
    residual = score(model, windows, initial_states).residual
    variables = variables_of(windows)
    return FlightReplay(
        variables["time"], np.where(windows.weight > 0.0, residual, np.nan), variables
    )


def variables_of(windows: Windows) -> dict[str, Array]:
    """The flight variables at every row of some windows: (W, L) each, the keys of VARIABLES."""
    at_windows = {name: np.empty_like(windows.nodes) for name in VARIABLES}
    for number, flight in enumerate(windows.flights):
        mine = windows.flight == number
        rows = nearest_index(flight.t - flight.t[0], windows.nodes[mine].ravel())
        for name, of_flight in _variables(flight).items():
            at_windows[name][mine] = of_flight[rows].reshape(-1, windows.nodes.shape[1])
    return at_windows


def replay_baseline(base: NominalModel) -> FlightReplay:
    """The baseline flight in its own model."""
    return replay(base.result.model, base.found.windows, base.result.initial_states)


def replay_flight(base: NominalModel, naming: Naming, model: Model | None = None) -> FlightReplay:
    """The flight under test in a model.

    None takes the nominal model, or, where nothing is missing, the nominal model fitted under its
    prior: coefficients drift by a percent from day to day, and that is no gap.
    """
    model = model or (naming.before.model if naming.verdict == "none" else base.result.model)
    windows = base.with_measurement_weights(naming.windows)
    return replay(model, windows, naming.before.initial_states)


def residual_map(flight: FlightReplay, calm: FlightReplay) -> tuple[ResidualBin, ...]:
    """Where a flight's residuals exceed the baseline's.

    Every channel is binned over every variable. A bin is significant where its excess would occur
    by chance in fewer than one of a hundred baseline flights, all bins together [Bonferroni;
    one-sided t test on windows]. Neighbouring significant bins in the upper half of the profile
    are joined.

    Returns:
        At most one bin per channel and variable, the largest contrast first; a channel with the
        same excess everywhere gives one bin over all the time.
    """
    from scipy.stats import t as student

    profiles = {(c, v): profile(flight, calm, c, v) for c in CHANNELS for v in VARIABLES}
    tests = sum(int(np.isfinite(p.excess_chi2).sum()) for p in profiles.values())
    needed = student.isf(FALSE_ALARM_PROBABILITY / max(tests, 1), max(len(calm.t) - 1, 1))
    residual_bins = []
    for channel in CHANNELS:
        found = []
        for variable in VARIABLES:
            p = profiles[channel, variable]
            counts = np.nan_to_num(p.excess_chi2 / p.error, nan=-np.inf) > needed
            if counts.any():
                found.append(_residual_bin(p, counts, channel, variable))
        contrast = [residual_bin for residual_bin in found if residual_bin.contrast > 0.0]
        residual_bins += contrast or (
            [_whole_flight_bin(profiles[channel, "time"], channel)] if found else []
        )
    return tuple(
        sorted(residual_bins, key=lambda s: (-s.contrast, -s.excess_chi2))[:MAX_RESIDUAL_BINS]
    )


def profile(
    flight: FlightReplay, calm: FlightReplay, channel: str, variable: str
) -> ResidualProfile:
    """Mean square residual of one channel (of CHANNELS) against one variable (of VARIABLES).

    Bins have equal numbers of rows of the flight; those of the heading have equal width.
    """
    at = CHANNELS.index(channel)
    values = flight.variables[variable]
    if variable == "heading":
        edges = np.linspace(-np.pi, np.pi, BINS + 1)
    else:
        edges = np.unique(np.quantile(values, np.linspace(0.0, 1.0, BINS + 1)))
    mean, rows = _bins(flight.residual[..., at], values, edges)
    whole, per_row = _baseline_statistics(calm.residual[..., at])
    calm_mean, calm_rows = _bins(calm.residual[..., at], calm.variables[variable], edges)
    elsewhere = np.isnan(calm_mean) | (variable == "time")
    calm_mean = np.where(elsewhere, whole, calm_mean)
    calm_rows = np.where(elsewhere, np.isfinite(calm.residual[..., at]).sum(), calm_rows)
    return ResidualProfile(
        edges, mean, calm_mean, per_row * np.sqrt(1.0 / np.maximum(rows, 1) + 1.0 / calm_rows)
    )


def _bins(residual: Array, values: Array, edges: Array) -> tuple[Array, np.ndarray]:
    """Mean square of each bin, nan where fewer than MIN_WINDOWS reach into it, and its rows."""
    inside = np.clip(np.searchsorted(edges, values, side="right") - 1, 0, max(len(edges) - 2, 0))
    inside[(values < edges[0]) | (values > edges[-1])] = -1
    seen = (inside[..., None] == np.arange(len(edges) - 1)) & np.isfinite(residual)[
        ..., None
    ]  # (W, L, B)
    squares = np.where(seen, np.nan_to_num(residual)[..., None] ** 2, 0.0).sum(axis=(0, 1))
    rows = seen.sum(axis=(0, 1))
    enough = seen.any(axis=1).sum(axis=0) >= MIN_WINDOWS
    return np.where(enough, squares / np.maximum(rows, 1), np.nan), rows


def _baseline_statistics(residual: Array) -> tuple[float, float]:
    """Mean square of a baseline channel (W, L), and its standard deviation per root of a row.

    Rows of one window are correlated, so the scatter is that between windows; assuming that the
    rows of a bin are spread over many windows is conservative.
    """
    rows = np.isfinite(residual).sum(axis=1)
    squares = np.nansum(residual**2, axis=1)
    mean = squares.sum() / max(rows.sum(), 1)
    spread = ((squares - mean * rows) ** 2).sum() * len(rows) / max(len(rows) - 1, 1)
    return float(mean), float(np.sqrt(spread / max(rows.sum(), 1)))


def _residual_bin(
    p: ResidualProfile, counts: np.ndarray, channel: str, variable: str
) -> ResidualBin:
    """The bin of largest excess, joined with significant neighbours in the upper half."""
    lower_bound = np.where(counts, p.excess_chi2 - 2.0 * p.error, -np.inf)
    low = high = int(np.argmax(lower_bound))
    known = np.nan_to_num(p.excess_chi2, nan=np.nanmin(p.excess_chi2))
    joined = counts & (known >= 0.5 * (p.excess_chi2[low] + known.min()))
    while low > 0 and joined[low - 1]:
        low -= 1
    while high < len(joined) - 1 and joined[high + 1]:
        high += 1
    inside = np.zeros(len(joined), dtype=bool)
    inside[low : high + 1] = True
    rest = p.excess_chi2[~inside & np.isfinite(p.excess_chi2)]
    excess_chi2 = float(p.excess_chi2[inside].mean())
    error = float(np.sqrt(np.mean(p.error[inside] ** 2) / inside.sum()))
    stands_out = excess_chi2 - max(float(rest.mean()), 0.0) - 2.0 * error if len(rest) else 0.0
    return ResidualBin(
        channel, variable, float(p.edges[low]), float(p.edges[high + 1]), excess_chi2, stands_out
    )


def _whole_flight_bin(p: ResidualProfile, channel: str) -> ResidualBin:
    """A channel whose excess is the same all the time."""
    return ResidualBin(
        channel,
        "time",
        float(p.edges[0]),
        float(p.edges[-1]),
        float(np.nanmean(p.excess_chi2)),
        0.0,
    )


def _variables(flight: PreparedFlight) -> dict[str, Array]:
    """The variables at every row of a flight, from locally smoothed poses and the commands."""
    t = flight.t - flight.t[0]
    velocity = flight.state_estimate[:, 6:9]
    rows = max(1, round(INPUT_AVERAGING_S / float(np.median(np.diff(t)))))
    # Mean of each command over the time before its row.
    padded = np.pad(flight.commands, ((rows - 1, 0), (0, 0)), mode="edge")
    mean_commands = [np.convolve(c, np.ones(rows) / rows, "valid") for c in padded.T]
    return {
        "time": flight.t,
        "x": flight.state_estimate[:, 0],
        "y": flight.state_estimate[:, 1],
        "height": flight.state_estimate[:, 2],
        "speed": np.linalg.norm(velocity, axis=1),
        "climb": velocity[:, 2],
        "heading": np.arctan2(velocity[:, 1], velocity[:, 0]),
        "bank": flight.state_estimate[:, 5],
        **dict(zip(("throttle", "aileron", "elevator", "rudder"), mean_commands, strict=True)),
    }
