"""Leaders: a manoeuvre's name and a seed -> the path of a simulated leader flown by the expert."""

import hashlib
import math
from dataclasses import dataclass, field

import numpy as np

from falconwing_kit.aircraft.airframe import load_airframe
from falconwing_kit.aircraft.model import Model, rates_model
from falconwing_kit.aircraft.trim import trim
from falconwing_kit.control.estimate import SimulatedAircraft
from falconwing_kit.control.expert import WaypointExpert
from falconwing_kit.control.guidance import Hall
from falconwing_kit.control.manoeuvres import MANOEUVRES
from falconwing_kit.control.plan import MARGIN, MIN_HEIGHT
from falconwing_kit.core.checks import Array, InputError, require_range
from falconwing_kit.core.messages import CONTROL_PERIOD_S, Observation, State

# Last word of the random generator's key; the other draws of a trial have another one.
LEADER_DRAWS = 2
PAST_COMMANDS = 30  # that the pilot is given
MAX_DURATION_RATIO = 3.0  # of a flight, to the time that its path takes at the pilot's speed


@dataclass(frozen=True)
class LeaderPath:
    """A leader's flight, simulated at 20 Hz."""

    manoeuvre: str
    seed: int
    t: Array  # (n,) [s]
    states: Array  # (n, 12) in the order of STATE_NAMES, SI, yaw unwrapped
    waypoints: Array = field(default_factory=lambda: np.zeros((0, 3)))  # (k, 3) planned [m]

    @property
    def digest(self) -> str:
        """SHA-256 of name, waypoints and states, rounded to 0.001 so that machines agree."""
        rounded = (np.round(values, 3) + 0.0 for values in (self.waypoints, self.states))  # no -0.0
        return hashlib.sha256(
            b"".join([self.manoeuvre.encode(), *(values.tobytes() for values in rounded)])
        ).hexdigest()

    @property
    def duration(self) -> float:
        """Time of the last sample [s]."""
        return float(self.t[-1])

    def state_at(self, t: float) -> State:
        """The leader's state at a time [s]; before the start and after the end it flies straight.

        Linear interpolation between samples, for the position Hermite's cubic with the velocities.
        """
        inside = min(max(t, 0.0), self.duration)
        i = min(int(inside / CONTROL_PERIOD_S), len(self.t) - 2)
        h = self.t[i + 1] - self.t[i]
        u = (inside - self.t[i]) / h
        a, b = self.states[i], self.states[i + 1]
        x = (1.0 - u) * a + u * b
        # Hermite's cubic as the chord plus u (1 - u) times a term linear in u.
        bend = (h * a[6:9] - (b[:3] - a[:3])) * (1.0 - u) - (h * b[6:9] - (b[:3] - a[:3])) * u
        x[:3] += u * (1.0 - u) * bend + (t - inside) * x[6:9]
        return State.from_vector(x)


def leader_path(manoeuvre: str, seed: int = 0, model: Model | None = None) -> LeaderPath:
    """Fly a manoeuvre in still air and without noise; the same arguments give the same bits.

    The leader follows predefined waypoints with the expert [paper, Section V-A].

    Args:
        manoeuvre: one of `MANOEUVRES`.
        seed: of the manoeuvre's draws: offset and scale of a plan, or random waypoints.
        model: the aircraft; None for the kit's own.

    Raises:
        InputError: there is no such manoeuvre, or this aircraft cannot fly it inside the hall.
    """
    if manoeuvre not in MANOEUVRES:
        raise InputError(f"manoeuvre: expected one of {', '.join(MANOEUVRES)}, got {manoeuvre!r}")
    number = MANOEUVRES[manoeuvre].number
    rng = np.random.default_rng([int(require_range("seed", seed, low=0)), number, LEADER_DRAWS])
    model = model or rates_model()
    waypoints = MANOEUVRES[manoeuvre].waypoints(rng)
    states = fly_path(model, WaypointExpert(model, load_airframe(), waypoints))
    if Hall().margin(states[:, :3]).min() < MARGIN / 2.0 or states[:, 2].min() < MIN_HEIGHT / 2.0:
        raise InputError(
            f"{manoeuvre}, seed {seed}: expected a flight {MARGIN / 2.0:g} m from walls and beams"
            f" and {MIN_HEIGHT / 2.0:g} m high or more, got nearer; check the model's values"
        )
    t = CONTROL_PERIOD_S * np.arange(len(states), dtype=np.float64)
    return LeaderPath(manoeuvre, seed, t, states, waypoints)


def fly_path(model: Model, pilot: WaypointExpert) -> Array:
    """Fly a pilot along its whole path without noise.

    Returns:
        (n, n_states) at 20 Hz, yaw unwrapped.
    """
    path = pilot.path
    # Start: the trim of the path's first climb angle, turned to its first course.
    x = trim(model, pilot.speed, float(path.climb[0])).state.copy()
    along = np.array([math.cos(path.yaw[0]), -math.sin(path.yaw[0])])
    x[:3], x[4] = path.p_world[0], x[4] + path.yaw[0]
    x[6:8] = along * x[6]
    aircraft, states = SimulatedAircraft(model, State.from_vector(x)), [x]
    past = np.zeros((PAST_COMMANDS, 4))
    max_states = MAX_DURATION_RATIO * path.length / pilot.speed / CONTROL_PERIOD_S
    while pilot.mode == "waypoints" and len(states) < max_states:
        command = pilot.act(Observation(aircraft.t, None, past, State.from_vector(aircraft.x)))
        past = np.concatenate([past[1:], command.vector[None]])
        aircraft.send(aircraft.t, command.vector)
        aircraft.advance(len(states) * CONTROL_PERIOD_S)
        states.append(aircraft.x.copy())
    flown = np.array(states)
    flown[:, 4] = np.unwrap(flown[:, 4])
    return flown
