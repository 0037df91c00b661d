"""Flights: situations and commands -> camera poses, the teacher's commands and true states, in
worker processes, step by step.

The world is the kit's own `SimulatedWorld`, and the teacher its own expert on the truth: the
true state, this very aircraft and the mean wind. It sits beside whatever pilot flies and says at
every step what it would do [DAgger, Ross, Gordon & Bagnell 2011].
"""

import multiprocessing
import os
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import partial
from multiprocessing.connection import Connection
from typing import Any

import numpy as np
from numpy.typing import NDArray

from falconwing_kit.aircraft.airframe import load_airframe
from falconwing_kit.aircraft.touchdown import LandingPad
from falconwing_kit.control.expert import FollowExpert, LandingExpert
from falconwing_kit.control.loops import SPEED, Autopilot
from falconwing_kit.core.checks import Array, InputError
from falconwing_kit.core.frames import euler_from_rotation
from falconwing_kit.core.messages import CONTROL_PERIOD_S, Command, Observation, State
from falconwing_kit.flight.judges import FollowEvaluator
from falconwing_kit.flight.loop import LoopStep, Pilot
from falconwing_kit.flight.sources import fpv_camera
from falconwing_kit.flight.world import PoseNoise, SimulatedWorld
from falconwing_kit.learning.situations import Ranges, Situation, draw_situation

PAST = 30  # commands that a pilot is given
AUXILIARY = 19  # numbers of `auxiliary_state`
LOST_STEPS = 20  # without the leader in view, after which nothing is to be learnt by seeing
Job = tuple[str, int, Ranges, Array]  # arguments of `draw_situation`


@dataclass(frozen=True, eq=False)
class Snapshot:
    """What the flights of a fleet are at one step; arrays over all B of them."""

    Ts_world_camera: Array  # (B, 4, 4)
    Ts_world_leader: Array  # (B, 4, 4), zero without a leader
    teacher: Array  # (B, 4) the teacher's commands
    auxiliary: Array  # (B, AUXILIARY) of the true state
    flies: NDArray[np.bool_]  # (B,) whether a flight goes on


class TrueState:
    """An observer that takes the observation's state as it is: here the true one."""

    effectiveness = np.ones(4)  # the model is the aircraft's

    def estimate(self, observation: Observation) -> State | None:
        """The true state."""
        return observation.state


def make_teacher(situation: Situation) -> Pilot:
    """The expert for a situation, designed on its aircraft and without integral action."""
    model, airframe, delay = situation.known_model, load_airframe(), situation.delay
    autopilot = partial(Autopilot, integrates=False)
    if situation.leader is not None:
        return FollowExpert(model, airframe, situation.leader, SPEED, delay, TrueState(), autopilot)
    return LandingExpert(model, airframe, LandingPad(), SPEED, delay, TrueState(), autopilot)


def make_world(situation: Situation) -> SimulatedWorld:
    """The world of a situation; its measured state is the true one."""
    pad = LandingPad() if situation.leader is None else None
    return SimulatedWorld(
        situation.model, load_airframe(), situation.start, seed=situation.seed, pad=pad,
        leader=situation.leader, noise=PoseNoise(0.0, 0.0), delay=situation.delay,
    )  # fmt: skip


class TaughtFlight:
    """One flight with its teacher beside the pilot."""

    def __init__(self, situation: Situation) -> None:
        self.situation, self.world = situation, make_world(situation)
        self._teacher = make_teacher(situation)
        self._judge = None
        if situation.leader is not None:
            self._judge = FollowEvaluator(
                self.world, situation.leader, load_airframe(), fpv_camera()
            )
        self._past = np.zeros((PAST, 4))
        self._unseen = 0  # steps since the leader was in view

    @property
    def flies(self) -> bool:
        """Whether it goes on: not after its time, a contact, or a second without its leader."""
        over = self.world.t > self.situation.duration - CONTROL_PERIOD_S
        return self.world.contact is None and not over and self._unseen < LOST_STEPS

    def teach(self) -> Array:
        """(4,) what the teacher would do now."""
        state = self.world.state
        if not np.isfinite(state.vector).all():
            return self._past[-1]
        observation = Observation(self.world.t, None, self._past, state)
        return self._teacher.act(observation).vector

    def advance(self, command: Array) -> None:
        """Send a command (4,) and fly one step."""
        throttle, aileron, elevator, rudder = command.tolist()
        sent = Command.clip(throttle, aileron, elevator, rudder)
        self._past = np.concatenate([self._past[1:], sent.vector[None]])
        self.world.send(self.world.t, sent)
        if self._judge is not None:
            self._judge.watch(LoopStep(self.world.t, None, None, sent, "", None))
        self.world.advance(self.world.t + CONTROL_PERIOD_S)
        self._unseen = 0 if self._leader_is_in_view() else self._unseen + 1

    def _leader_is_in_view(self) -> bool:
        """Whether the leader's centre of gravity is inside the image; True without a leader."""
        leader, camera = self.situation.leader, fpv_camera()
        if leader is None:
            return True
        p_world = leader.state_at(self.world.t).p_world
        T_world_camera = self.world.state.pose.T_world_body @ self.situation.T_body_camera
        (uv,), (depth,) = camera.project(p_world[None], T_world_camera)
        return bool(depth > 0.0 and 0.0 <= uv[0] < camera.width and 0.0 <= uv[1] < camera.height)

    def outcome(self) -> dict[str, Any]:
        """What it came to: the contact, and the measures of a touchdown."""
        contact = self.world.contact
        record: dict[str, Any] = {"seed": self.situation.seed, "t": self.world.t}
        record["contact"] = contact.obstacle if contact else ""
        if self._judge is not None:
            judged = self._judge.result()
            del judged["path_m"], judged["leader_path_m"]
            return record | judged
        touchdown = contact.touchdown if contact else None
        if touchdown is not None:
            record |= {
                "landed": touchdown.on_pad,
                "ald_m": touchdown.absolute_lateral_deviation,
                "past_threshold_m": touchdown.past_threshold,
                "sink_rate_m_s": touchdown.sink_rate,
            }
        return record


def auxiliary_state(situation: Situation, state: State, t: float) -> Array:
    """(AUXILIARY,) what a pilot should know of a true state at t [s], on a scale of about one."""
    if situation.leader is None:
        return _landing_auxiliary(situation, state)
    return _follow_auxiliary(state, situation.leader.state_at(t), situation.delay)


def _landing_auxiliary(situation: Situation, state: State) -> Array:
    """The place relative to the pad, also per distance; own motion; trim, wind and delay."""
    pad, values = LandingPad(), situation.known_model.values
    left = pad.x_start - state.p_world[0]
    aside, height = state.p_world[1] - pad.y_centre, state.p_world[2]
    per_distance = 5.0 / (abs(left) + 2.0)
    place = [left / 10.0, aside, height, aside * per_distance, height * per_distance, state.yaw]
    v_body = state.pose.T_world_body[:3, :3].T @ state.v_world
    own = [state.roll, state.pitch, *(v_body - (SPEED, 0.0, 0.0)) / 2.0, *state.rates_body / 2.0]
    trims = [10.0 * values[a] / values[b] for a, b in (("L_0", "L_da"), ("N_0", "N_dr"))]
    winds = [values["mean_wind_x"], values["mean_wind_y"]]
    return np.array([*place, *own, *trims, *winds, 10.0 * (situation.delay - 0.1)])


def _follow_auxiliary(state: State, leader: State, delay: float) -> Array:
    """The leader's place, attitude and velocity seen from the follower; own motion; delay."""
    R_world_body = state.pose.T_world_body[:3, :3]
    p_body = R_world_body.T @ (leader.p_world - state.p_world)
    distance = float(np.linalg.norm(p_body))
    place = [*p_body / 4.0, distance / 4.0, *(5.0 * p_body[1:] / (distance + 0.5))]
    R_world_leader = leader.pose.T_world_body[:3, :3]
    R_body_leader = R_world_body.T @ R_world_leader
    attitude = [float(a) for a in euler_from_rotation(np.diag((1.0, -1.0, -1.0)) @ R_body_leader)]
    v_body = R_world_body.T @ (leader.v_world - state.v_world)
    own = [state.roll, state.pitch, *state.rates_body / 2.0, state.p_world[2] / 2.0]
    return np.array([*place, *attitude, *v_body / 2.0, *own, 10.0 * (delay - 0.1)])


class Fleet:
    """Many flights in worker processes, advanced together."""

    def __init__(self, workers: int) -> None:
        """Start the workers; 0 flies in this process."""
        self.workers = workers
        self._locals: list[_Squad] = []
        self._pipes: list[Connection] = []
        self._processes: list[Any] = []
        self._rows: list[NDArray[np.int64]] = []
        context = multiprocessing.get_context("spawn")
        for _ in range(workers):
            here, there = context.Pipe()
            process = context.Process(target=_serve, args=(there,), daemon=True)
            process.start()
            there.close()
            self._pipes.append(here)
            self._processes.append(process)
        if not workers:
            self._locals = [_Squad()]

    def prepare(self, jobs: Sequence[Job]) -> None:
        """Draw the next flights and design their teachers; the workers do it meanwhile."""
        count = max(self.workers, 1)
        self._rows = np.array_split(np.arange(len(jobs)), count)  # neighbours share a design
        self._call("prepare", [[jobs[i] for i in rows] for rows in self._rows])

    def begin(self) -> list[Situation]:
        """Wait until they are ready; the situations in the order of the jobs."""
        return self._ordered(self._answers("prepare"))

    def send(self, commands: Array | None) -> None:
        """Fly one step by commands (B, 4); None asks for the first snapshot."""
        parts = [None if commands is None else commands[rows] for rows in self._rows]
        self._call("step", parts)

    def snapshot(self) -> Snapshot:
        """Wait for the step; what the flights are now."""
        parts = self._answers("step")
        order = np.argsort(np.concatenate(self._rows))
        fields = (np.concatenate(part)[order] for part in zip(*parts, strict=True))
        return Snapshot(*fields)

    def outcomes(self) -> list[dict[str, Any]]:
        """What the flights came to."""
        self._call("outcomes", [None] * max(self.workers, 1))
        return self._ordered(self._answers("outcomes"))

    def close(self) -> None:
        """End the workers."""
        for pipe in self._pipes:
            with suppress(OSError):  # it has ended already
                pipe.send(("close", None))
        for process in self._processes:
            process.join(timeout=5.0)
            if process.is_alive():
                process.terminate()

    def _call(self, verb: str, parts: Sequence[Any]) -> None:
        self._waiting = parts
        for pipe, part in zip(self._pipes, parts, strict=False):
            pipe.send((verb, part))

    def _answers(self, verb: str) -> list[Any]:
        if self._locals:
            return [getattr(self._locals[0], verb)(self._waiting[0])]
        answers = [pipe.recv() for pipe in self._pipes]
        for answer in answers:
            if isinstance(answer, str):
                raise InputError(f"flights: expected a step, got an error in a worker: {answer}")
        return answers

    def _ordered(self, parts: list[list[Any]]) -> list[Any]:
        found: list[Any] = [None] * sum(len(rows) for rows in self._rows)
        for rows, part in zip(self._rows, parts, strict=True):
            for row, item in zip(rows, part, strict=True):
                found[row] = item
        return found


class _Squad:
    """The flights of one process."""

    def __init__(self) -> None:
        self._flights: list[TaughtFlight] = []

    def prepare(self, jobs: Sequence[Job]) -> list[Situation]:
        self._flights = [TaughtFlight(draw_landable(*job)) for job in jobs]
        return [flight.situation for flight in self._flights]

    def step(self, commands: Array | None) -> tuple[Array, ...]:
        count = len(self._flights)
        cameras, leaders = np.zeros((count, 4, 4)), np.zeros((count, 4, 4))
        teacher, auxiliary = np.zeros((count, 4)), np.zeros((count, AUXILIARY))
        flies = np.zeros(count, bool)
        for k, flight in enumerate(self._flights):
            if commands is not None and flight.flies:
                flight.advance(commands[k])
            flies[k] = flight.flies
            situation, state, t = flight.situation, flight.world.state, flight.world.t
            if flies[k] and not np.isfinite(state.vector).all():
                flies[k] = False
            cameras[k] = np.eye(4)
            if not flies[k]:
                continue
            cameras[k] = state.pose.T_world_body @ situation.T_body_camera
            teacher[k] = flight.teach()
            auxiliary[k] = auxiliary_state(situation, state, t)
            if situation.leader is not None:
                leaders[k] = situation.leader.state_at(t).pose.T_world_body
        return cameras, leaders, teacher, auxiliary, flies

    def outcomes(self, _: None) -> list[dict[str, Any]]:
        return [flight.outcome() for flight in self._flights]


def draw_landable(task: str, seed: int, ranges: Ranges, nominal_mount: Array) -> Situation:
    """`draw_situation`, drawn again where the teacher cannot be designed."""
    for attempt in range(20):
        situation = draw_situation(task, seed + 1_000_000 * attempt, ranges, nominal_mount)
        try:
            make_teacher(situation)
        except InputError:
            continue
        return situation
    raise InputError(f"aircraft: expected one that can be flown for seed {seed}, got none")


def _serve(pipe: Connection) -> None:
    """A worker: answers the fleet's calls until it closes."""
    os.environ["OMP_NUM_THREADS"] = "1"
    squad = _Squad()
    while True:
        try:
            verb, argument = pipe.recv()
        except EOFError:
            return
        if verb == "close":
            return
        try:
            pipe.send(getattr(squad, verb)(argument))
        except Exception as error:
            pipe.send(f"{type(error).__name__}: {error}")
