"""Simulated flights with known parameters: a model in, noisy flight tables out. Simulated, not measured."""

import numpy as np

from falconwing_kit.aircraft.integrate import step_batch
from falconwing_kit.aircraft.model import Model, record_of, state_rates
from falconwing_kit.core.flight_table import FlightTable

DT, FINE = 0.05, 5  # 20 Hz rows, 10 ms integration: five times finer than the fit's own


def fly_figure_eights(
    models: list[Model], seconds: float, rng: np.random.Generator
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """A simple autopilot flies figure eights inside the hall and shakes all sticks; one aircraft per model.

    Returns times (N,), states (B, N, n), stick positions (B, N, 4).
    """
    first, count, rows = models[0], len(models), round(seconds / DT) + 1
    K = record_of(first.names)(*np.array([m.vector for m in models]).T)
    rates = state_rates(first.form, first.terms, first.winds)
    x = np.zeros((first.n_states, count))
    x[2], x[3], x[6] = 2.2, 0.1, 7.0
    states, sticks = np.empty((rows, *x.shape)), np.empty((rows, 4, count))
    t = np.arange(rows) * DT
    frequencies = 2.0 * np.pi * rng.uniform(0.15, 1.6, (4, 6, 1, count))
    shake = np.sin(frequencies * t[:, None] + rng.uniform(0, 6.28, (4, 6, 1, count))).sum(axis=1)
    amplitude = np.array([0.035, 0.07, 0.06, 0.08])[:, None, None]
    shake = np.moveaxis(shake * amplitude, 1, 0)
    acting, back = (
        np.repeat(np.array([0.4, 0.0, 0.0, 0.0])[:, None], count, axis=1),
        np.round(K.delay / (DT / FINE)).astype(int),
    )
    for k in range(rows):
        states[k] = x
        sticks[k] = _autopilot(x, t[k]) + shake[k]
        sticks[k, 0], sticks[k, 1:] = np.clip(sticks[k, 0], 0, 1), np.clip(sticks[k, 1:], -1, 1)
        for j in range(FINE):
            row = np.maximum((k * FINE + j - back) // FINE, 0)
            wanted = sticks[row, :, np.arange(count)].T
            kept = np.exp(-DT / FINE / np.maximum(K.lag, 1e-9))
            after = wanted + (acting - wanted) * kept
            mean = wanted - K.lag / (DT / FINE) * (after - acting)
            acting = after
            x = step_batch(rates, K, t[k] + j * DT / FINE, x, mean, DT / FINE)
    return t, states.transpose(2, 0, 1), sticks.transpose(2, 0, 1)


def _autopilot(x: np.ndarray, t: float) -> np.ndarray:
    """Bank toward one of two circles, hold height and speed."""
    px, py, height, pitch, _, roll = x[:6]
    vx, vy, vz = x[6:9]
    side = np.where(np.mod(t, 16.0) < 8.0, 1.0, -1.0)
    centre_x, centre_y = -2.0 + 7.0 * side, -2.0
    away = np.hypot(px - centre_x, py - centre_y)
    bearing = np.arctan2(py - centre_y, px - centre_x)
    # Circle to the left around +x, to the right around -x; yaw grows to the right.
    wanted_course = bearing + side * (np.pi / 2 + np.clip(0.25 * (away - 6.0), -1.2, 1.2))
    course = np.arctan2(vy, vx)
    error = -np.angle(np.exp(1j * (wanted_course - course)))
    bank = np.clip(-side * 0.65 + 1.2 * error, -0.9, 0.9)
    climb = np.clip(0.9 * (2.2 - height), -0.8, 0.8)
    speed = np.sqrt(vx**2 + vy**2 + vz**2)
    pitch_wanted = 0.12 + 0.16 * (climb - vz) + 0.16 * bank**2
    return np.stack([
        0.42 + 0.12 * (7.2 - speed) + 0.15 * climb,
        0.9 * (bank - roll),
        1.2 * (pitch_wanted - pitch) + 0.25 * bank**2,
        0.25 * bank,
    ])  # fmt: skip


def measured_table(
    t: np.ndarray, states: np.ndarray, sticks: np.ndarray, rng: np.random.Generator,
    noise: tuple[float, float] = (0.03, np.radians(0.6)), outliers: float = 0.0, missing: float = 0.0,
) -> FlightTable:  # fmt: skip
    """Poses as a camera would measure them: white noise, some poses off by metres, some missing."""
    count = len(t)
    p = states[:, :3] + rng.normal(0, noise[0], (count, 3))
    angles = states[:, [5, 3, 4]] + rng.normal(0, noise[1], (count, 3))
    angles = (angles + np.pi) % (2 * np.pi) - np.pi
    off, lost = rng.random(count) < outliers, rng.random(count) < missing
    p[off] += rng.normal(0, 3.0, (off.sum(), 3))
    angles[off] += rng.normal(0, 0.8, (off.sum(), 3))
    p[lost], angles[lost] = np.nan, np.nan
    return FlightTable("simulated", t, p, angles, sticks, {}, {}, ())
