"""Diagnosis pilot: a manoeuvre that a report proposes -> a pilot who flies it leg by leg in the
hall, for a JSBSim aircraft.

He flies up and down the hall's long side, at the next leg's height and speed; a leg begins when he
is straight and has room for it ahead. He sees the true state, as the pilot of the figure eights.
"""

import numpy as np

from falconwing_kit.core.frames import GRAVITY
from falconwing_kit.core.messages import COMMAND_NAMES
from falconwing_kit.gap.advice import DiagnosisManoeuvre, Leg
from tests.jsbsim_aircraft import ROW, SPEED, Array, Pilot

LEG_S = 2.0  # of a leg, as the advice counts it
TURN_BANK = 0.8  # [rad]
TURN_AT, LENGTH = 6.0, 17.5  # m from the middle, along the hall: he turns back; no turn goes beyond


def diagnosis_pilot(manoeuvre: DiagnosisManoeuvre, place: Array | None = None) -> Pilot:
    """A pilot who repeats the legs of a manoeuvre. A new one for each flight.

    Args:
        manoeuvre: its legs are flown in turn.
        place: (2,) that legs pass which lead through a place [m]; None: the middle of the hall.
    """
    number, begun, way, trim = 0, -np.inf, 1.0, 0.2  # leg and its begin, along x, elevator

    def pilot(t: float, state: Array) -> Array:
        nonlocal number, begun, way, trim
        leg = manoeuvre.legs[number % len(manoeuvre.legs)]
        if np.isfinite(begun) and t - begun >= LEG_S:
            number, begun = number + 1, -np.inf
            leg = manoeuvre.legs[number % len(manoeuvre.legs)]
        if way * state[0] > TURN_AT and not np.isfinite(begun):
            way = -way
        aside = _aside(leg, way, place) - state[1]
        wanted = np.arctan2(np.clip(aside / 5.0, -1.0, 1.0), way)
        to_the_right = (np.arctan2(state[7], state[6]) - wanted + np.pi) % (2.0 * np.pi) - np.pi
        if not np.isfinite(begun) and abs(to_the_right) < 0.4 and _has_room(leg, t, state):
            begun = t
        flying = bool(np.isfinite(begun))
        turn = float(np.clip(1.2 * to_the_right, -TURN_BANK, TURN_BANK))
        trim += 0.1 * ROW * (leg.height - state[2]) * (not (flying and leg.glide))
        sticks = _hold(leg, leg.bank if flying else turn, trim, state)
        if flying:
            if leg.glide:
                sticks[0] = 0.0
            for name, move in leg.sticks.items():
                sticks[COMMAND_NAMES.index(name)] += float(move(np.array(t - begun)))
        return np.clip(sticks, [0.0, -1.0, -1.0, -1.0], 1.0)

    return pilot


def _has_room(leg: Leg, t: float, state: Array) -> bool:
    """Whether a leg from here ends, wings level, where a turn back stays in the hall."""
    end = state[0] + LEG_S * state[6]
    radius = (leg.speed * SPEED) ** 2 / (GRAVITY * np.tan(TURN_BANK))
    steady = abs(state[5]) < 0.3 and abs(state[2] - leg.height) < 0.4
    return bool(t >= leg.later and steady and abs(end) < LENGTH - radius)


def _aside(leg: Leg, way: float, place: Array | None) -> float:
    """The line along the hall: its middle, or the leg's distance to the left of the place [m]."""
    return 0.0 if leg.beside is None or place is None else float(place[1] + way * leg.beside)


def _hold(leg: Leg, bank: float, trim: float, state: Array) -> Array:
    """Sticks (4,) that hold a leg's height and speed and a bank: the law of the figure eights."""
    _, _, height, pitch, _, roll, vx, vy, vz = state[:9]
    climb = np.clip(0.9 * (leg.height - height), -0.8, 0.8)
    climb += 3.0 * max(0.5 - height - 0.6 * vz, 0.0)  # the floor must not be touched
    speed = leg.speed * SPEED
    return np.array([
        0.35 + 0.3 * (speed - np.sqrt(vx**2 + vy**2 + vz**2)) + 0.15 * climb,
        0.9 * (bank - roll),
        trim + 0.12 + 0.16 * (climb - vz) + 0.43 * bank**2 - pitch,
        0.25 * bank,
    ])  # fmt: skip
