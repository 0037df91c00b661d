"""Flights of an aircraft that is not ours, JSBSim's, for tests: a pilot who sees the true state
-> times, states and sticks.
"""

from collections.abc import Callable

import numpy as np

from falconwing_kit.tools.trials.jsbsim_aircraft import (
    EARTH_RADIUS,
    FOOT,
    SEA_LEVEL_DENSITY,
    STEP,
    STICKS,
    BeforeStep,
    JsbsimAircraft,
    kit_state,
    new_fdm,
)

__all__ = [
    "EARTH_RADIUS",
    "FOOT",
    "ROW",
    "SEA_LEVEL_DENSITY",
    "STEP",
    "STICKS",
    "BeforeStep",
    "JsbsimAircraft",
    "figure_eights",
    "fly_jsbsim",
    "kit_state",
    "new_fdm",
    "playback",
]

Array = np.ndarray
Pilot = Callable[[float, Array], Array]  # t, state (12,) -> sticks (4,)

ROW = 0.05  # s between rows of a flight
RADIUS, HEIGHT, SPEED = 4.5, 2.2, 7.0  # what the pilot holds: of the two circles [m], [m], [m/s]


def fly_jsbsim(
    aircraft: JsbsimAircraft, pilot: Pilot, seconds: float, start: Array | None = None,
    step: float = STEP, before_step: BeforeStep | None = None,
) -> tuple[Array, Array, Array]:  # fmt: skip
    """Fly with a pilot who sees the true state and moves the sticks 20 times a second.

    Args:
        aircraft: what flies.
        pilot: (t, state) -> sticks; `playback` and `figure_eights` make two.
        seconds: length of the flight.
        start: (12,) start state in the kit's frames, servos settled at the first sticks; None:
            level at speed.
        step: JSBSim's integration step [s], a whole fraction of 50 ms.
        before_step: called before every step with the time and JSBSim; may set any property.

    Returns:
        t (N,) [s], states (N, 12) in the order of STATE_NAMES (yaw unwrapped), sticks (N, 4).
    """
    rows, per_row = round(seconds / ROW) + 1, round(ROW / step)
    begin = (
        np.array([0.0, 0.0, HEIGHT, 0.1, 0.0, 0.0, SPEED, *[0.0] * 5]) if start is None else start
    )
    t, states, sticks = np.arange(rows) * ROW, np.empty((rows, 12)), np.empty((rows, 4))
    states[0], sticks[0] = begin, pilot(0.0, begin)
    fdm = new_fdm(aircraft, begin, sticks[0], step)
    on_their_way = [sticks[0]] * round(aircraft.delay / step)  # one a step
    for k in range(1, rows):
        for j in range(per_row):
            on_their_way.append(sticks[k - 1])
            for name, stick in zip(STICKS, on_their_way.pop(0), strict=True):
                fdm[f"falcon/{name}-stick"] = float(stick)
            if before_step is not None:
                before_step(t[k - 1] + j * step, fdm)
            fdm.run()
        states[k] = kit_state(fdm)
        sticks[k] = pilot(t[k], states[k])
    states[:, 4] = np.unwrap(states[:, 4])
    return t, states, sticks


def playback(sticks: Array) -> Pilot:
    """A pilot who repeats sticks (N, 4), a row each 50 ms."""
    return lambda t, state: sticks[min(round(t / ROW), len(sticks) - 1)]


def figure_eights(rng: np.random.Generator, shake: float = 1.0, one_way: bool = False) -> Pilot:
    """A pilot who flies figure eights in a hall of 40 x 20 m and shakes all sticks. A new one for
    each flight.

    Args:
        rng: draws frequencies (0.15 to 1.6 Hz) and phases of the shaking.
        shake: 1 excites every parameter within a minute or two, 0 not at all.
        one_way: circle to the left only.
    """
    frequency, phase = (
        2.0 * np.pi * rng.uniform(0.15, 1.6, (6, 4)),
        rng.uniform(0.0, 2.0 * np.pi, (6, 4)),
    )
    amplitude = shake * np.array([0.035, 0.07, 0.06, 0.08])
    side, far = (
        1.0,
        False,
    )  # left around the circle at +x, right around the one at -x; they touch at the origin
    trim = 0.2  # of the elevator, found on the way, so that any drawn aircraft holds its height

    def pilot(t: float, state: Array) -> Array:
        nonlocal side, far, trim
        px, py, height, pitch, _, roll, vx, vy, vz = state[:9]
        far = far or side * px > RADIUS + 1.0
        if far and side * px < 2.5 and not one_way:
            side, far = -side, False
        from_x, from_y = px - RADIUS * side, py
        outside = np.clip(0.25 * (np.hypot(from_x, from_y) - RADIUS), -1.2, 1.2)
        course = np.arctan2(from_y, from_x) + side * (np.pi / 2 + outside)
        to_the_right = (np.arctan2(vy, vx) - course + np.pi) % (2.0 * np.pi) - np.pi
        bank = np.clip(-0.75 * side + 1.2 * to_the_right, -0.9, 0.9)
        climb = np.clip(0.9 * (HEIGHT - height), -0.8, 0.8)
        trim += 0.1 * ROW * (HEIGHT - height)
        sticks = (
            0.35 + 0.3 * (SPEED - np.sqrt(vx**2 + vy**2 + vz**2)) + 0.15 * climb,
            0.9 * (bank - roll),
            trim + 0.12 + 0.16 * (climb - vz) + 0.43 * bank**2 - pitch,
            0.25 * bank,
        )
        shaken = sticks + amplitude * np.sin(frequency * t + phase).sum(axis=0)
        return np.clip(shaken, [0.0, -1.0, -1.0, -1.0], 1.0)

    return pilot
