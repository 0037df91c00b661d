"""Leaders: a manoeuvre's name and a seed -> the path a leader flew, by the kit's own model and
expert. Simulated.
"""

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
from falconwing_kit.control.loops import STEP_S
from falconwing_kit.control.manoeuvres import MANOEUVRES
from falconwing_kit.control.plan import MARGIN, MIN_HEIGHT
from falconwing_kit.core.checks import Array, InputError, require_range
from falconwing_kit.core.messages import Observation, State

LEADER_DRAWS = (
    2  # last word of the generator's key: whatever else a trial draws has a key with another one
)


@dataclass(frozen=True)
class LeaderPath:
    """What a leader flew, simulated at 20 Hz."""

    manoeuvre: str
    seed: int
    t: Array  # (n,) [s]
    states: Array  # (n, 12) in the order of STATE_NAMES, SI; yaw does not jump
    waypoints: Array = field(
        default_factory=lambda: np.zeros((0, 3))
    )  # (k, 3) that were to be flown along [m]

    @property
    def digest(self) -> str:
        """Of the manoeuvre's name, its waypoints and the states, rounded to 0.001 so that machines
        agree.
        """
        rounded = (
            np.round(values, 3) + 0.0 for values in (self.waypoints, self.states)
        )  # + 0.0: no minus zero
        return hashlib.sha256(
            b"".join([self.manoeuvre.encode(), *(values.tobytes() for values in rounded)])
        ).hexdigest()

    @property
    def duration(self) -> float:
        """How long the manoeuvre takes [s]."""
        return float(self.t[-1])

    def state(self, t: float) -> State:
        """The leader at a time [s]: between samples by straight lines, its place by the cubic that
        its velocity gives.

        Before the start and after the end it goes straight on.
        """
        inside = min(max(t, 0.0), self.duration)
        i = min(int(inside / STEP_S), len(self.t) - 2)
        h = self.t[i + 1] - self.t[i]
        u = (inside - self.t[i]) / h
        a, b = self.states[i], self.states[i + 1]
        x = (1.0 - u) * a + u * b
        bend = (h * a[6:9] - (b[:3] - a[:3])) * (1.0 - u) - (h * b[6:9] - (b[:3] - a[:3])) * u
        x[:3] += u * (1.0 - u) * bend + (t - inside) * x[6:9]
        return State.from_vector(x)


def leader_path(manoeuvre: str, seed: int = 0, model: Model | None = None) -> LeaderPath:
    """Fly a manoeuvre; the same arguments give the same bits.

    The leader follows predefined waypoints with the expert [paper, Section V-A], in still air and
    without noise.

    Args:
        manoeuvre: one of `MANOEUVRES`.
        seed: shifts the plan by up to half a metre and stretches it by up to 5 %, or draws the
            random waypoints.
        model: the aircraft; None for the kit's own.

    Returns:
        The path.

    Raises:
        InputError: there is no such manoeuvre, or this aircraft cannot fly it inside the hall.
    """
    if manoeuvre not in MANOEUVRES:
        raise InputError(f"manoeuvre: expected one of {', '.join(MANOEUVRES)}, got {manoeuvre!r}")
    number = MANOEUVRES[manoeuvre].number
    rng = np.random.default_rng([int(require_range("seed", seed, low=0)), number, LEADER_DRAWS])
    model, airframe = model or rates_model(), load_airframe()
    waypoints = MANOEUVRES[manoeuvre].waypoints(rng)
    pilot = WaypointExpert(model, airframe, waypoints)
    states = fly_path(model, pilot)
    if Hall().margin(states[:, :3]).min() < MARGIN / 2.0 or states[:, 2].min() < MIN_HEIGHT / 2.0:
        raise InputError(
            f"{manoeuvre}, seed {seed}: the aircraft leaves the hall's safe room; check the model's values"
        )
    return LeaderPath(
        manoeuvre, seed, STEP_S * np.arange(len(states), dtype=np.float64), states, waypoints
    )


def fly_path(model: Model, pilot: WaypointExpert) -> Array:
    """Fly a pilot along its path from its first point to its last, without noise.

    Args:
        model: the aircraft.
        pilot: whose path and speed count.

    Returns:
        (n, n_states) at 20 Hz; yaw does not jump.
    """
    path = pilot.path
    x = trim(model, pilot.speed, float(path.climb[0])).state.copy()
    along = np.array([math.cos(path.yaw[0]), -math.sin(path.yaw[0])])
    x[:3], x[4] = path.p_world[0], x[4] + path.yaw[0]
    x[6:8] = along * x[6]
    aircraft, past, flown = SimulatedAircraft(model, State.from_vector(x)), np.zeros((30, 4)), [x]
    while pilot.mode == "waypoints" and len(flown) < 3.0 * path.length / pilot.speed / STEP_S:
        command = pilot.act(Observation(aircraft.t, None, past, State.from_vector(aircraft.x)))
        past = np.concatenate([past[1:], command.vector[None]])
        aircraft.send(aircraft.t, command.vector)
        aircraft.advance(len(flown) * STEP_S)
        flown.append(aircraft.x.copy())
    states = np.array(flown)
    states[:, 4] = np.unwrap(states[:, 4])
    return states
