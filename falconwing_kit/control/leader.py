"""Leaders: a manoeuvre's name and a seed -> the path a leader flew, by the kit's own model and expert. Simulated."""

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from falconwing_kit.aircraft.airframe import load_airframe
from falconwing_kit.aircraft.model import Model, rates_model
from falconwing_kit.aircraft.trim import trim
from falconwing_kit.control.estimate import FlyingAircraft
from falconwing_kit.control.expert import WaypointExpert
from falconwing_kit.control.guidance import Hall
from falconwing_kit.control.loops import STEP_S, course_axes
from falconwing_kit.core.checks import Array, InputError, require_range
from falconwing_kit.core.messages import Observation, State

MARGIN = 1.0  # m that a leader keeps from walls and beams; its half span is 0.35 m
LOWEST = 0.7  # m above the floor
TRIES, KNOTS = 500, 8  # of random waypoints
LEADER_DRAWS = 2  # last word of the generator's key: whatever else a trial draws has a key with another one


@dataclass(frozen=True)
class LeaderPath:
    """What a leader flew, simulated at 20 Hz."""

    manoeuvre: str
    seed: int
    t: Array  # (n,) [s]
    states: Array  # (n, 12) in the order of STATE_NAMES, SI; yaw does not jump

    @property
    def duration(self) -> float:
        """How long the manoeuvre takes [s]."""
        return float(self.t[-1])

    def state(self, t: float) -> State:
        """The leader at a time [s]: between samples by straight lines, its place by the cubic that its velocity gives.

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

    The leader follows predefined waypoints with the expert [paper, Section V-A], in still air and without noise.

    Args:
        manoeuvre: one of `MANOEUVRES`.
        seed: shifts the plan by up to half a metre and stretches it by up to 5 %, or draws the random waypoints.
        model: the aircraft; None for the kit's own.

    Returns:
        The path.

    Raises:
        InputError: there is no such manoeuvre, or this aircraft cannot fly it inside the hall.
    """
    if manoeuvre not in MANOEUVRES:
        raise InputError(f"manoeuvre: want one of {', '.join(MANOEUVRES)}, got {manoeuvre!r}")
    number = list(MANOEUVRES).index(manoeuvre)
    rng = np.random.default_rng([int(require_range("seed", seed, low=0)), number, LEADER_DRAWS])
    model, airframe = model or rates_model(), load_airframe()
    pilot = WaypointExpert(model, airframe, MANOEUVRES[manoeuvre](rng))
    states = fly_path(model, pilot)
    if Hall().margin(states[:, :3]).min() < MARGIN / 2.0 or states[:, 2].min() < LOWEST / 2.0:
        raise InputError(
            f"{manoeuvre}, seed {seed}: the aircraft leaves the hall's safe room; check the model's values"
        )
    return LeaderPath(manoeuvre, seed, STEP_S * np.arange(len(states), dtype=np.float64), states)


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
    aircraft, past, flown = FlyingAircraft(model, State.from_vector(x)), np.zeros((30, 4)), [x]
    while pilot.mode == "waypoints" and len(flown) < 3.0 * path.length / pilot.speed / STEP_S:
        command = pilot.act(Observation(aircraft.t, None, past, State.from_vector(aircraft.x)))
        past = np.concatenate([past[1:], command.vector[None]])
        aircraft.send(aircraft.t, command.vector)
        aircraft.advance(len(flown) * STEP_S)
        flown.append(aircraft.x.copy())
    states = np.array(flown)
    states[:, 4] = np.unwrap(states[:, 4])
    return states


# The hall is 40 m long, and the paper's manoeuvres begin 6.5 m from its end so that a follower has room behind.


@dataclass(frozen=True)
class Plan:
    """A manoeuvre on paper: its first point and course, and how it bends; straight lines between the knots."""

    start: tuple[float, float, float]  # [m]
    yaw_deg: float
    s: tuple[float, ...]  # knots along the way [m]
    curvature: tuple[float, ...]  # at the knots, positive to the right [1/m]
    climb_deg: tuple[float, ...]  # at the knots
    shift: tuple[float, float, float] = (0.5, 0.5, 0.2)  # a seed moves it by up to so much each way [m]
    stretch: float = 0.05  # and enlarges it by up to this share

    def waypoints(self, rng: np.random.Generator) -> Array:
        """A point every metre (n, 3) [m], moved and enlarged as the seed says."""
        start = np.array(self.start) + rng.uniform(-1.0, 1.0, 3) * self.shift
        way = bent(math.radians(self.yaw_deg), np.array(self.s), np.array(self.curvature), np.radians(self.climb_deg))
        return np.asarray(start + rng.uniform(1.0, 1.0 + self.stretch) * way)


def bent(yaw: float, s: Array, curvature: Array, climb: Array) -> Array:
    """Points a metre apart of a curve from the origin, from its curvature and climb.

    d(yaw)/ds = curvature, d(x, y, z)/ds = (cos yaw, -sin yaw, tan climb), s the level way.

    Args:
        yaw: first course [rad].
        s: (k,) knots [m], from 0.
        curvature: (k,) positive to the right [1/m].
        climb: (k,) [rad].

    Returns:
        (n, 3) [m]; the first is the origin.
    """
    middle = np.arange(0.05, s[-1], 0.1)  # steps of 0.1 m, by the midpoint rule
    course = yaw + 0.1 * (np.cumsum(bend := np.interp(middle, s, curvature)) - 0.5 * bend)
    steps = 0.1 * np.column_stack([np.cos(course), -np.sin(course), np.tan(np.interp(middle, s, climb))])
    return np.concatenate([np.zeros((1, 3)), np.cumsum(steps, axis=0)])[::10]


def random_waypoints(rng: np.random.Generator) -> Array:
    """Waypoints every metre of a way that bends and climbs at random, with room on all sides.

    Knot by knot: what would leave the hall is drawn again, and where that does not help, all of it.

    Args:
        rng: draws start and course, then curvature and climb at knots 5 m apart.

    Returns:
        (n, 3) [m].

    Raises:
        InputError: the hall is too small for any.
    """
    for _ in range(TRIES):
        start, yaw = rng.uniform((-21.5, -11.0, 1.2), (16.5, 7.0, 3.8)), rng.uniform(-math.pi, math.pi)
        behind = start - 6.0 * course_axes(yaw)[0]  # where a follower may begin
        bends = [np.zeros(2)]
        for _ in range(10 * KNOTS):
            bend = rng.uniform(-1.0, 1.0, 2) * (0.105, 0.12)
            tried = [*bends, bend, bend * (1.0, 0.0), bend * (1.0, 0.0)]  # there must be a way on
            curvature, climb = np.array(tried).T
            s = np.linspace(0.0, 5.0 * (len(tried) - 1), len(tried))
            points = np.vstack([behind, start + bent(yaw, s, curvature, climb)])
            if np.all(Hall().margin(points) > MARGIN) and np.all(points[:, 2] > LOWEST):
                bends = tried[:-2]
            if len(bends) == KNOTS:
                return np.asarray(points[1:-10])
    raise InputError(f"random waypoints: none of {TRIES} draws stayed inside the hall; take another seed")


_S_KNOTS = (0.0, 4.0, 7.0, 12.0, 17.0, 22.0, 25.0, 29.0)
_S_LEFT = (0.0, 0.0, -0.09, -0.09, 0.09, 0.09, 0.0, 0.0)
# Two lobes of 8.9 m radius; the arc's length is the one that brings each lobe back to the middle.
_LOBE = (0.0, 1.0, 5.0, 51.184, 55.184, 56.184)
_RIGHT_LOBE = (0.0, 0.0, 1 / 8.9, 1 / 8.9, 0.0, 0.0)
PLANS = {
    "left_turn_s_descent": Plan(
        (-16.0, -5.0, 3.5), 0.0, _S_KNOTS, _S_LEFT, (0.0, 0.0, -5.0, -6.0, -6.0, -5.0, 0.0, 0.0)
    ),
    "right_turn_s_ascent": Plan(
        (-16.0, 1.0, 1.3), 0.0, _S_KNOTS, tuple(-k for k in _S_LEFT), (0.0, 0.0, 5.0, 6.0, 6.0, 5.0, 0.0, 0.0)
    ),
    "right_turn_sharp_climb": Plan(
        (-16.0, 5.0, 1.0), 0.0, (0.0, 3.0, 7.0, 15.0, 17.0, 19.0, 21.0, 25.0),
        (0.0, 0.0, 0.1, 0.1, 0.1, 0.05, 0.0, 0.0), (0.0, 1.0, 11.0, 11.0, 6.0, 1.0, 0.0, 0.0),
    ),
    "figure_eight": Plan(
        (-2.5, -2.0, 2.2), -71.536, (*_LOBE, *(56.184 + s for s in _LOBE[1:])),
        (*_RIGHT_LOBE, *(-k for k in _RIGHT_LOBE[1:])), (0.0,) * 11, (0.1, 0.1, 0.2), 0.0,
    ),
}  # fmt: skip
MANOEUVRES: dict[str, Callable[[np.random.Generator], Array]] = {
    **{name: plan.waypoints for name, plan in PLANS.items()},
    "random_waypoints": random_waypoints,
}
