"""Leaders: a manoeuvre's name and a seed -> the path a leader flew, by the kit's own model and expert. Simulated."""

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from falconwing_kit.aircraft.airframe import Airframe, load_airframe
from falconwing_kit.aircraft.integrate import SUBSTEPS, step_batch
from falconwing_kit.aircraft.model import Model, rates_model, state_rates
from falconwing_kit.aircraft.trim import trim
from falconwing_kit.control.expert import WaypointExpert
from falconwing_kit.control.guidance import Hall, Path, require_flyable
from falconwing_kit.control.loops import LINK_DELAY_S, SPEED, STEP_S
from falconwing_kit.core.checks import Array, InputError, require_range
from falconwing_kit.core.messages import Command, Observation, State

MARGIN = 1.0  # m that a leader keeps from walls and ceiling; its half span is 0.35 m
LOWEST = 0.7  # m above the floor
TRIES = 400  # of random waypoints, and of legs for each
SETTLED_S = 0.6  # a servo of 30 ms has forgotten where it was


class FlyingAircraft:
    """A model in flight: commands go in and act late, the true state comes out."""

    def __init__(self, model: Model, start: State, delay: float = LINK_DELAY_S) -> None:
        """Begin at t = 0; the first command is taken to have acted before."""
        self.t, self.x = 0.0, start.vector[: model.n_states].copy()
        self._model, self._delay, self._K = model, require_range("delay", delay, low=0.0, high=1.0), model.K
        self._rates = state_rates(model.form, model.terms, model.winds)
        self._times: list[float] = []
        self._sticks: list[Array] = []
        late = (model.values.get(name, 0.0) for name in ("actuator_lag", "lag_in_series"))
        self._memory = SETTLED_S + 12.0 * max(late)

    def send(self, t: float, command: Command) -> None:
        """Give a command at a time [s] not before the last one; it arrives `delay` later."""
        self._times.append(t + self._delay)
        self._sticks.append(command.vector)

    def advance(self, t: float) -> None:
        """Fly until t [s]; with no command yet, the sticks are neutral and the throttle idle."""
        steps = math.ceil((t - self.t) / STEP_S * SUBSTEPS[self._model.form] - 1e-9)
        if steps <= 0:
            return
        dt = (t - self.t) / steps
        before = math.ceil(self._memory / dt)
        edges = self.t + dt * np.arange(-before, steps + 1)
        times = np.array(self._times or [0.0])
        sticks = np.array(self._sticks or [np.zeros(4)])
        recent = max(int(np.searchsorted(times, edges[0] - 1.0, side="right")) - 1, 0)
        mean, swing = self._model.acting(times[recent:], sticks[recent:], edges, self._K)
        x = self.x[:, None]
        for k in range(before, before + steps):
            x = step_batch(self._rates, self._K, edges[k], x, mean[k, :, None], dt, swing[k, :, None])
        self.t, self.x = t, x[:, 0]


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
        seed: shifts the paper's manoeuvres by up to half a metre and stretches them by up to 5 %; draws random waypoints.
        model: the aircraft; None for the kit's own.

    Returns:
        The path.

    Raises:
        InputError: there is no such manoeuvre, or this aircraft cannot fly it inside the hall.
    """
    if manoeuvre not in MANOEUVRES:
        raise InputError(f"manoeuvre: want one of {', '.join(MANOEUVRES)}, got {manoeuvre!r}")
    rng = np.random.default_rng([int(require_range("seed", seed, low=0)), list(MANOEUVRES).index(manoeuvre)])
    model, airframe = model or rates_model(), load_airframe()
    pilot = WaypointExpert(model, airframe, MANOEUVRES[manoeuvre](rng, airframe))
    states = fly_path(model, pilot)
    if Hall().margin(states[:, :3]).min() < MARGIN / 2.0 or states[:, 2].min() < LOWEST / 2.0:
        raise InputError(
            f"{manoeuvre}, seed {seed}: the aircraft leaves the hall's safe room; check the model's values"
        )
    return LeaderPath(manoeuvre, seed, STEP_S * np.arange(len(states)), states)


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
        aircraft.send(aircraft.t, command)
        aircraft.advance(len(flown) * STEP_S)
        flown.append(aircraft.x.copy())
    states = np.array(flown)
    states[:, 4] = np.unwrap(states[:, 4])
    return states


# Waypoints: the hall is 40 m long, a leader begins 6 m from its end so that a follower has room behind it ---------------


def _s_turn(left: float, z_start: float, z_end: float) -> Callable[[np.random.Generator, Airframe], Array]:
    """An S: first to one side, then back to the first course, 7 m beside it; a half cosine over 20 m."""

    def waypoints(rng: np.random.Generator, airframe: Airframe) -> Array:
        x = np.concatenate([np.arange(-4.0, 20.1, 1.0), [22.0, 25.0]])
        share = np.clip(x / 20.0, 0.0, 1.0)
        y = -left * 3.5 * np.cos(np.pi * share)
        z = z_start + (z_end - z_start) * 0.5 * (1.0 - np.cos(np.pi * np.clip((x + 4.0) / 28.0, 0.0, 1.0)))
        return _varied(rng, np.column_stack([x - 12.5, y - 2.0, z]))

    return waypoints


def _sharp_climb(rng: np.random.Generator, airframe: Airframe) -> Array:
    """A right turn of 120 deg that climbs 3 m within 20 m."""
    s = np.arange(0.0, 33.0, 1.0)
    rate = np.interp(s, [0.0, 5.0, 9.0, 25.0, 29.0, 33.0], [0.0, 0.0, 0.1, 0.1, 0.0, 0.0])
    yaw = np.cumsum(rate)
    climb = np.interp(s, [0.0, 3.0, 7.0, 21.0, 25.0, 33.0], np.radians([0.0, 0.0, 10.0, 10.0, 0.0, 0.0]))
    steps = np.column_stack([np.cos(yaw), -np.sin(yaw), np.tan(climb)])
    return _varied(rng, np.array([-16.5, 4.0, 1.1]) + np.cumsum(steps, axis=0))


def _figure_eight(rng: np.random.Generator, airframe: Airframe) -> Array:
    """A level eight, x = a sin u, y = b sin 2u [Gerono's lemniscate], once around."""
    u = np.linspace(0.0, 2.0 * np.pi, 49)
    return _varied(rng, np.column_stack([-2.5 + 17.0 * np.sin(u), -2.0 + 8.3 * np.sin(2.0 * u), np.full(len(u), 2.0)]))


def _random_waypoints(rng: np.random.Generator, airframe: Airframe) -> Array:
    """Legs of 8 m with random turns and climbs, drawn until all are inside the hall and within the aircraft's limits."""
    for _ in range(TRIES):
        points, yaw = [np.array([-17.0, rng.uniform(-8.0, 4.0), rng.uniform(1.2, 3.5)])], 0.0
        points.append(points[0] + (4.0, 0.0, 0.0))
        for _ in range(6):
            for _ in range(20):
                turn, climb = rng.uniform(-0.9, 0.9), rng.uniform(-0.1, 0.1)
                step = 8.0 * np.array([math.cos(yaw + turn), -math.sin(yaw + turn), climb])
                if _has_room(points[-1] + step):
                    break
            points.append(points[-1] + step)
            yaw += turn
        try:
            path = Path(np.array(points))
            require_flyable(path, SPEED, airframe.bank_limit)
        except InputError:
            continue
        if _has_room(path.p_world):
            return np.array(points)
    raise InputError(f"random waypoints: none of {TRIES} tries stayed inside the hall; take another seed")


def _varied(rng: np.random.Generator, points: Array) -> Array:
    """Shifted by up to half a metre level and 0.2 m in height, stretched along the hall by up to 5 %."""
    points = points * (1.0 + rng.uniform(-0.05, 0.05), 1.0, 1.0)
    return np.asarray(points + rng.uniform(-1.0, 1.0, 3) * (0.5, 0.5, 0.2))


def _has_room(p_world: Array) -> bool:
    return bool(np.all(Hall().margin(p_world) > MARGIN) and np.all(p_world[..., 2] > LOWEST))


MANOEUVRES: dict[str, Callable[[np.random.Generator, Airframe], Array]] = {
    "left_turn_s_descent": _s_turn(1.0, 3.6, 1.3),
    "right_turn_s_ascent": _s_turn(-1.0, 1.3, 3.6),
    "right_turn_sharp_climb": _sharp_climb,
    "figure_eight": _figure_eight,
    "random_waypoints": _random_waypoints,
}
