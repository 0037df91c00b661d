"""Simulated flights with known parameters: models -> true states and noisy flight tables.

The simulation differs from the fit: a servo solved in closed form on 10 ms steps, a pilot in the
loop, noise of a seeded generator.
"""

from dataclasses import dataclass
from functools import cache

import numpy as np

from falconwing_kit.aircraft.integrate import step_batch
from falconwing_kit.aircraft.model import Model, parameter_record, rates_model, state_rates
from falconwing_kit.core.flight_table import FlightTable
from falconwing_kit.sysid.identify import Identification, identify

DT, FINE = (
    0.05,
    5,
)  # s between rows; integration steps a row, so 10 ms: two and a half times finer than the fit's
MARKER = (0.03, float(np.radians(0.6)))  # m, rad: pose noise per axis of the printed marker
CORRELATION_S = 0.5  # of slow pose noise
RADIUS, HEIGHT, SPEED = 4.5, 2.2, 7.0  # what the pilot holds: of the two circles [m], [m], [m/s]


@dataclass(frozen=True)
class Flown:
    """B true flights of N rows."""

    t: np.ndarray  # (N,) [s]
    states: np.ndarray  # (B, N, n) in the order of STATE_NAMES, SI
    sticks: np.ndarray  # (B, N, 4) in the order of COMMAND_NAMES
    lost: np.ndarray  # (N,) rows without a frame, so without a new command


def drawn(model: Model, rng: np.random.Generator, spread: float = 0.15) -> Model:
    """A random aircraft: parameters times exp(spread * normal), zeros plus 0.1 spread normal."""
    free = [p.name for p in model.parameters if p.low < p.high]
    normal = rng.normal(size=(2, len(free)))
    return model.with_values({
        name: model.values[name] * np.exp(spread * a) or 0.1 * spread * b
        for name, a, b in zip(free, *normal, strict=True)
    })  # fmt: skip


def fly_figure_eights(
    models: list[Model], seconds: float, rng: np.random.Generator,
    shake: float = 1.0, jitter: float = 0.0, lost: float = 0.0, held: tuple[int, ...] = (),
) -> Flown:  # fmt: skip
    """Fly figure eights of about 40 m by 30 m with excited control inputs; models of one form.

    Args:
        models: the aircraft.
        seconds: length of the flights.
        rng: draws frequencies (0.15 to 1.6 Hz) and phases of the excitation.
        shake: 1 excites every parameter within a minute or two, 0 none.
        jitter: largest deviation of a frame, and its commands, from its time [s].
        lost: share of the frames that are lost.
        held: numbers of the control inputs that stay at zero.
    """
    first, count, rows = models[0], len(models), round(seconds / DT) + 1
    K = parameter_record(first.names)(*np.array([m.vector for m in models]).T)
    rates = state_rates(first.form, first.terms, first.winds)
    pilot = _figure_eights(rng, count, shake, held)
    t = np.arange(rows) * DT + rng.uniform(-jitter, jitter, rows)
    is_lost = (rng.random(rows) < lost) & (t > DT)
    x = np.zeros((first.n_states, count))
    x[2], x[3], x[6] = HEIGHT, 0.1, SPEED
    states, commands = np.empty((rows, *x.shape)), np.empty((rows, 4, count))
    # Positions of the servos, settled at the first commands.
    position, lag = pilot(0.0, x), np.maximum(K.lag, 1e-9)
    for k in range(rows):
        states[k], commands[k] = x, commands[k - 1] if is_lost[k] else pilot(t[k], x)
        if k == rows - 1:
            break
        h = (t[k + 1] - t[k]) / FINE
        for now in t[k] + h * np.arange(FINE):
            # First-order lag towards `before` until the change, then towards `after`.
            before, after, old = _arriving(t, commands, k, now + 1e-9 - K.delay, h)
            at_change = before + (position - before) * np.exp(-old / lag)
            end = after + (at_change - after) * np.exp(-(h - old) / lag)
            mean = (before * old + after * (h - old) - lag * (end - position)) / h
            slope = np.where(lag > h, 0.5 * (end - position), 0.0)  # without lag it jumps
            x = step_batch(rates, K, now, x, mean, h, slope)
            position = end
    return Flown(t, states.transpose(2, 0, 1), commands.transpose(2, 0, 1), is_lost)


def _arriving(t, commands, k, sent, h):
    """Inputs (4, B) at the servos at start and end of a step, and the time of the change (B,)."""
    row = np.clip(np.searchsorted(t, sent, side="right") - 1, 0, k)
    each = np.arange(len(row))
    until_next = np.where(sent < t[0], h, t[row + 1] - sent)
    following = commands[np.minimum(row + 1, k), :, each].T
    return commands[row, :, each].T, following, np.minimum(until_next, h)


def _figure_eights(rng, count, shake, held):
    """The pilot: true states (n, B) -> inputs (4, B); left around one circle, right around the
    other.
    """
    frequency = 2.0 * np.pi * rng.uniform(0.15, 1.6, (6, 4, count))
    phase = rng.uniform(0.0, 2.0 * np.pi, (6, 4, count))
    amplitude = shake * np.array([0.035, 0.07, 0.06, 0.08])[:, None]
    side, far, trim = np.ones(count), np.zeros(count, bool), np.full(count, 0.05)

    def pilot(t, x):
        nonlocal side, far, trim
        px, py, height, pitch, _, roll, vx, vy, vz = x[:9]
        far = far | (side * px > RADIUS + 1.0)
        turning = far & (side * px < 2.5)
        side, far = np.where(turning, -side, side), far & ~turning
        from_x = px - RADIUS * side
        outside = np.clip(0.25 * (np.hypot(from_x, py) - RADIUS), -1.2, 1.2)
        course = np.arctan2(py, from_x) + side * (np.pi / 2 + outside)
        to_the_right = (np.arctan2(vy, vx) - course + np.pi) % (2.0 * np.pi) - np.pi
        bank = np.clip(-0.75 * side + 1.2 * to_the_right, -0.9, 0.9)
        climb = np.clip(0.9 * (HEIGHT - height), -0.8, 0.8)
        trim = np.clip(trim + 0.1 * DT * (HEIGHT - height), -0.4, 0.4)
        commands = np.stack([
            0.42 + 0.2 * (SPEED - np.sqrt(vx**2 + vy**2 + vz**2)) + 0.15 * climb,
            0.9 * (bank - roll),
            trim + 1.2 * (0.12 + 0.16 * (climb - vz) + 0.16 * bank**2 - pitch) + 0.25 * bank**2,
            0.25 * bank,
        ])  # fmt: skip
        commands += amplitude * np.sin(frequency * t + phase).sum(axis=0)
        commands[list(held)] = 0.0
        return np.clip(commands, np.array([0.0, -1.0, -1.0, -1.0])[:, None], 1.0)

    return pilot


def measured(
    flown: Flown, rng: np.random.Generator, which: int = 0, noise: tuple[float, float] = MARKER,
    outliers: float = 0.0, missing: float = 0.0, slow: float = 0.0,
) -> FlightTable:  # fmt: skip
    """Poses as a camera would measure them; there is no row where the frame never came.

    Args:
        flown: the true flights.
        rng: draws the noise.
        which: of the flights.
        noise: standard deviation of positions [m] and angles [rad].
        outliers: share of poses that are off by 3 m and 45 deg per axis (standard deviation).
        missing: share of rows without a pose.
        slow: share of the noise's variance that is correlated over 0.5 s.
    """
    taken = ~flown.lost
    states, count = flown.states[which, taken], int(taken.sum())
    error = np.sqrt(1.0 - slow) * rng.normal(size=(count, 6)) + np.sqrt(slow) * correlated(
        count, rng
    )
    p_world = states[:, :3] + noise[0] * error[:, :3]
    angles = states[:, [5, 3, 4]] + noise[1] * error[:, 3:]
    off, lost = rng.random(count) < outliers, rng.random(count) < missing
    p_world[off] += rng.normal(0.0, 3.0, (off.sum(), 3))
    angles[off] += rng.normal(0.0, 0.8, (off.sum(), 3))
    p_world[lost], angles[lost] = np.nan, np.nan
    angles = (angles + np.pi) % (2.0 * np.pi) - np.pi
    return FlightTable("simulated", flown.t[taken], p_world, angles, flown.sticks[which, taken])


def correlated(count: int, rng: np.random.Generator) -> np.ndarray:
    """(count, 6) noise of unit variance whose correlation falls to 1/e in 0.5 s: AR(1)."""
    kept = np.exp(-DT / CORRELATION_S)
    noise = rng.normal(size=(count, 6))
    for k in range(1, count):
        noise[k] = kept * noise[k - 1] + np.sqrt(1.0 - kept**2) * noise[k]
    return noise


@cache
def example_flight() -> tuple[Model, Flown, FlightTable]:
    """A 60 s flight with marker noise, outliers and lost frames: aircraft, truth, table."""
    rng = np.random.default_rng(2)
    truth = drawn(rates_model(), rng)
    flown = fly_figure_eights([truth], 60.0, rng)
    return truth, flown, measured(flown, rng, outliers=0.005, missing=0.01)


@cache
def example_found() -> Identification:
    """`identify` on the example flight, computed once for all tests."""
    return identify([example_flight()[2]])
