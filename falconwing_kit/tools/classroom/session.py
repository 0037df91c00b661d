"""Session: a task, an autopilot and students' sticks -> flights without end, logs and verdicts.

The kit's own loop flies in real time. Requests of the class (effects, pause, slow motion, another
start) are taken between two steps, so each is an event of the log at the time at which it acts.
"""

import threading
import time
from collections import deque
from collections.abc import Callable
from contextlib import ExitStack, suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Protocol

import numpy as np

from falconwing_kit import __version__
from falconwing_kit.aircraft.effect import Effect
from falconwing_kit.aircraft.effects import CATALOGUE
from falconwing_kit.aircraft.model import Model
from falconwing_kit.control.expert import landing_speed
from falconwing_kit.core.checks import InputError
from falconwing_kit.core.flight_log import FlightLogWriter
from falconwing_kit.core.messages import CONTROL_PERIOD_S, SAFE_COMMAND, Command, Observation, State
from falconwing_kit.flight.loop import Clock, ImageSource, Loop, LoopStep, Pilot
from falconwing_kit.flight.pilots import PILOTS, load_pilot
from falconwing_kit.flight.sources import MeasuredStates, RenderedView, fpv_camera
from falconwing_kit.flight.tasks import TASKS, TRIAL_SEEDS, trial_seed
from falconwing_kit.flight.trial import FlightTask, TrialSetup
from falconwing_kit.flight.world import SimulatedWorld
from falconwing_kit.scene.gaussians import GaussianScene
from falconwing_kit.tools.bridge.open_port import simulated_board
from falconwing_kit.tools.bridge.through_port import PortWorld
from falconwing_kit.tools.classroom import channel
from falconwing_kit.tools.classroom.autopilot import LapsAndLanding
from falconwing_kit.tools.classroom.envelope import envelope_problem
from falconwing_kit.tools.classroom.hands import Hands
from falconwing_kit.tools.classroom.results import (
    FlightRecord,
    live_verdict,
    model_with_effects,
)
from falconwing_kit.tools.classroom.supervise import AutopilotSupervisor

FOLLOWED = "figure_eight"  # manoeuvre of a class where none is named: the longest
LONGEST_FLIGHT_S = 120.0  # of a landing, laps included
IDLE_PERIOD_S = 0.05  # between two states while nothing flies or time stands still
SLOWEST, FASTEST = 0.1, 4.0  # speeds of time
STRETCH = 1.02  # of time, from which on the page says so
STATION_M = 4.0  # behind the leader, where the follower is caught again
PHASES = (
    "", "joins the circuit", "laps", "approach", "flare", "landed", "follow", "a student flies",
    "a student flies with the assist", "sticks neutral, motor idle", "no state",
)  # fmt: skip
STUDENT, ASSISTED, SAFE = PHASES[7:10]


class Publisher(Protocol):
    """Where a session reports."""

    def state(self, data: bytes) -> None:
        """A step, packed by `channel.pack_state`."""

    def text(self, kind: str, **fields: Any) -> None:
        """A message of the protocol."""

    def step(self, session: "Session", step: LoopStep, truth: State) -> None:
        """A step, for the picture of the nose camera."""

    def finished(self, record: FlightRecord) -> None:
        """A flight whose log is complete."""


@dataclass(frozen=True)
class SessionSettings:
    """What a class flies."""

    folder: Path  # of the logs
    task: str = "landing"
    manoeuvre: str = ""
    scene: str = "arena"  # its name, for the logs
    pilot: str = "expert"  # the autopilot; "manual" for none
    seed: int = 0
    laps: int = 2  # before a landing
    port: str = ""  # a simulated board that all commands go through; "" for none
    pause_s: float = 4.0  # after a verdict
    keep: int = 60  # logs; older ones are removed


class ClassClock:
    """Real time without dropped steps, which can be slowed, hastened and stopped while it runs.

    A late step delays all that follow, as with `PacedClock`; `stretch` is by how much. A hurried
    step comes at once, so that all that follow come up to a period earlier.
    """

    def __init__(self, on_wait: Callable[[], None] = lambda: None) -> None:
        """on_wait: called while time stands still, every IDLE_PERIOD_S."""
        self.speed, self.paused, self._on_wait = 1.0, False, on_wait
        self.ended, self._hurried = threading.Event(), threading.Event()
        self._t, self._due = 0.0, time.perf_counter()
        self._recent: deque[tuple[float, float]] = deque(maxlen=1000)  # real time, delay [s]

    def start(self) -> None:
        """Set the time to zero."""
        self._t, self._due = 0.0, time.perf_counter()

    def now(self) -> float:
        """Time of the flight [s]; constant between two steps."""
        return self._t

    def wait_until(self, t: float) -> None:
        """Return at time t [s], later where the class pauses or the machine is late."""
        due, now = self._due + (t - self._t) / self.speed, time.perf_counter()
        if self.paused:
            while self.paused and not self.ended.wait(IDLE_PERIOD_S):
                self._on_wait()
            due = now = time.perf_counter()
            self._hurried.clear()
        self._recent.append((now, max(now - due, 0.0)))
        self._due = max(due, now)
        self._t = max(self._t, t)
        if (left := self._due - now) > 0.0 and self._hurried.wait(left):
            self._due = time.perf_counter()
        self._hurried.clear()

    def hurry(self) -> None:
        """End the present wait, from any thread: the next step is due at once."""
        self._hurried.set()

    def stretch(self) -> float:
        """Real time over the time that the steps of the last second should have taken, >= 1."""
        now = time.perf_counter()
        delay = sum(late for at, late in self._recent if now - at <= 1.0)
        return 1.0 / max(1.0 - min(delay, 0.9), 0.1)


class Session:
    """Flights one after the other, in the thread that calls `run`; requests from any thread."""

    def __init__(
        self, settings: SessionSettings, publisher: Publisher, hands: Hands, *,
        scene: Callable[[], GaussianScene | None] = lambda: None,
        clock: Callable[["Session"], Clock] | None = None,
    ) -> None:  # fmt: skip
        """Check the settings.

        Args:
            settings: what is flown.
            publisher: where steps, events and flights are reported.
            hands: who holds the sticks, and how they stand.
            scene: the hall as soon as it is there, for an autopilot that flies by images.
            clock: of every flight; None for one `ClassClock`.

        Raises:
            InputError: there is no such task, manoeuvre or pilot, or it does not fly the task.
        """
        self.settings, self.hands, self.number = settings, hands, 0
        self.clock = ClassClock(self._while_paused)
        self._publisher, self._scene = publisher, scene
        self._make_clock = clock or (lambda session: session.clock)
        self._task = make_task(settings.task, settings.manoeuvre)
        self._manoeuvre = settings.manoeuvre
        self._requests: deque[tuple[str, Any]] = deque()
        self._ended, self._wake = threading.Event(), threading.Event()
        self._active: dict[str, dict[str, float]] = {}  # effects that are on: drawn parameters
        self._step_times: deque[float] = deque(maxlen=200)
        self._last_state = b""
        self._logs: deque[tuple[Path, bool]] = deque()  # of this session, and whether to keep
        self.recording = False
        self._repeat_seed = False
        self._ahead: tuple[Any, int, TrialSetup] | None = None  # task, seed and its world
        self._stop_reason = ""
        self.log: FlightLogWriter | None = None
        self.flight_number = 0
        self._last_step: tuple[LoopStep, State] | None = None
        self._holder, self._names = "", list[str]()
        self._t = 0.0

    # Requests, from any thread
    # -------------------------

    def request(self, what: str, value: Any = None) -> None:
        """Ask for something between two steps.

        Args:
            what: "pause", "speed", "restart", "effect", "task", "record", "end" or "again"; "step"
                for the next step at once.
            value: bool for pause and record, the factor of time for speed, (name, bool) for an
                effect, (task, manoeuvre) for a task.
        """
        if what == "step":
            self.clock.hurry()
            return
        if what == "end":
            self._ended.set()
            self.clock.ended.set()
        if what == "pause":
            self.clock.paused = bool(value)
        if what == "speed":
            self.clock.speed = min(max(float(value), SLOWEST), FASTEST)
        self._requests.append((what, value))
        self._wake.set()

    @property
    def task(self) -> Any:
        """What is flown."""
        return self._task

    @property
    def active_effects(self) -> list[str]:
        """Names of the effects that are on."""
        return list(self._active)

    @property
    def model(self) -> Model:
        """The aircraft that flies, with the effects that are on."""
        model: Model = self._task.model
        return model_with_effects(model, self._active)

    # The flying thread
    # -----------------

    def run(self, flights: int | None = None) -> None:
        """Fly until "end" is asked for, or so many flights.

        A flight that fails is reported and the next one begins.
        """
        flown, failed = 0, 0
        while not self._ended.is_set() and (flights is None or flown < flights):
            try:
                self._fly_one()
                failed = 0
            except Exception as error:  # the class goes on, whatever a pilot, a disk or a port does
                failed += 1
                self._publisher.text("error", text=f"The flight ended: {error}")
                self._rest(min(2.0 * failed, 10.0))
            flown += 1
        self.hands.end()

    def _fly_one(self) -> None:
        """One flight, from its start to its verdict and the pause after it."""
        settings, task = self.settings, self._task
        if not self._repeat_seed:
            self.number += 1
        self._repeat_seed, self._stop_reason = False, ""
        number = self.number
        self.flight_number += 1
        seed = self._seed(number)
        trial = self._trial_of(task, seed)
        path = settings.folder / f"flight_{self.flight_number:04d}.mcap"
        self._names, self._t = [], 0.0
        with ExitStack() as stack:
            self.log = stack.enter_context(FlightLogWriter(path))
            stack.callback(lambda: setattr(self, "log", None))
            world: SimulatedWorld | PortWorld = trial.world
            self.log.metadata(self._metadata(trial))
            self._trial = trial
            if settings.port:
                board = simulated_board(settings.port)
                stack.callback(board.close)
                world = stack.enter_context(
                    PortWorld(
                        trial.world, board, on_event=lambda t, name, d: self._event(t, name, d)
                    )
                )
            view = self._view(world)
            camera = fpv_camera()
            judge = task.judge(trial, camera, None)
            pilot = ClassPilot(self, trial, self._autopilot(trial))
            supervisor = self._supervisor(pilot)
            effects = tuple(self._active)
            self._start_effects()
            self._publish_flight(trial)
            if settings.pilot == "manual":
                self._wait_for_student(trial)
            loop = Loop(
                pilot, world, view, MeasuredStates(world), trial.leader,
                self._make_clock(self), self.log, (self._show,), supervisor,
            )  # fmt: skip

            def watch(step: LoopStep) -> str:
                return judge.watch(step) or self._stop_reason

            flight = loop.run(trial.duration, watch)
            self._hands_events(self._t)
        reason, handed_back = flight.reason, supervisor.reason if supervisor is not None else ""
        if handed_back:
            self._say(self._t, "handed back", f"The supervisor handed back: {handed_back}.")
        self._logs.append((path, self.recording))
        self._forget_old_logs()
        record = FlightRecord(
            number=self.flight_number, log=path, task=settings_task(task),
            manoeuvre=self._manoeuvre_name(), scene=settings.scene, seed=seed,
            autopilot=settings.pilot, holders=tuple(self._names), effects=effects,
        )  # fmt: skip
        if reason in ("interrupted",):
            self._ended.set()
        if self._stop_reason:
            self._publisher.text(
                "event", t=self._t, flight=self.flight_number, name="ended",
                text=f"Flight {self.flight_number} was ended: {self._stop_reason}.",
            )  # fmt: skip
            return
        verdict = live_verdict(task, trial, judge.result(), reason, handed_back)
        self._publisher.text(
            "verdict", flight=self.flight_number, sentence=verdict.sentence,
            success=verdict.success, numbers=verdict.numbers, holders=list(self._names),
            logged=str(path) if self.recording else None,
        )  # fmt: skip
        self._publisher.finished(record)
        begin = time.monotonic()
        if trial.leader is not None:  # whose flight takes seconds to simulate
            following = self._seed(self.number + 1)
            self._ahead = task, following, self._trial_of(task, following)
        self._rest(settings.pause_s - (time.monotonic() - begin))

    def _wait_for_student(self, trial: TrialSetup) -> None:
        """Show the start until someone holds the sticks: without an autopilot nobody else flies."""
        truth = trial.world.state
        self._last_step = (
            LoopStep(0.0, None, truth, SAFE_COMMAND, SAFE, trial.world.leader_state),
            truth,
        )
        while self.hands.holder != "student" and not self._ended.is_set():
            self._idle(0)

    def _seed(self, number: int) -> int:
        """Seed of a flight by its number, from 1."""
        return trial_seed((number - 1) % TRIAL_SEEDS, self.settings.seed)

    def _trial_of(self, task: Any, seed: int) -> TrialSetup:
        """The world of a seed, simulated ahead where there is a leader."""
        ahead, self._ahead = self._ahead, None
        if ahead is not None and ahead[0] is task and ahead[1] == seed:
            return ahead[2]
        return replace_duration(task.trial(seed), task)

    def _metadata(self, trial: TrialSetup) -> dict[str, object]:
        import json

        settings = self.settings
        return {
            "simulated": "yes", "task": settings_task(self._task),
            "manoeuvre": self._manoeuvre_name(), "scene": settings.scene, "seed": trial.seed,
            "pilot": settings.pilot, "aircraft": self._task.airframe.name,
            "model": "rates_model", "kit_version": __version__,
            "start": json.dumps(trial.world.state.vector.tolist()), "port": settings.port,
        }  # fmt: skip

    def _manoeuvre_name(self) -> str:
        return str(getattr(self._task, "manoeuvre", ""))

    def _view(self, world: SimulatedWorld | PortWorld) -> ImageSource | None:
        """Images, only for an autopilot that flies by them; it waits for the hall."""
        pilot = PILOTS.get(self.settings.pilot)
        if pilot is None or pilot.reads_state:
            return None
        while (scene := self._scene()) is None and not self._ended.is_set():
            self._idle()
        if scene is None:
            raise InputError("scene: the class ended before it was there")
        return RenderedView(world, scene, fpv_camera(), self._task.airframe.p_body_camera)

    def _supervisor(self, pilot: "ClassPilot") -> AutopilotSupervisor | None:
        """Over the autopilot; None without one."""
        autopilot = PILOTS.get(self.settings.pilot)
        if autopilot is None or self.settings.pilot == "manual":
            return None
        return AutopilotSupervisor(lambda: pilot.student_flies, by_images=not autopilot.reads_state)

    def _autopilot(self, trial: TrialSetup) -> Callable[[bool], Pilot] | None:
        """What makes the autopilot, at the start or (True) where a student hands back."""
        settings, task = self.settings, self._task
        if settings.pilot == "manual":
            return None
        if trial.leader is not None:

            def follow(again: bool) -> Pilot:
                pilot = task.expert(trial)
                if again:
                    pilot.station = np.array([STATION_M, 0.0, 0.0])
                return pilot

            return follow
        if settings.pilot == "expert":
            make_expert = lambda: task.expert(trial)  # noqa: E731
        else:
            make_expert = lambda: load_pilot(  # noqa: E731
                settings.pilot, settings_task(task), "hall", fpv_camera(),
                task.airframe.p_body_camera, airframe=task.airframe,
            )  # fmt: skip

        def laps(again: bool) -> Pilot:
            if not again and (settings.laps == 0 or not PILOTS[settings.pilot].reads_state):
                return make_expert()
            return LapsAndLanding(
                task.model, task.airframe, task.pad, make_expert,
                landing_speed(task.model),
                laps=0 if again else settings.laps,
            )  # fmt: skip

        return laps

    # Between two steps
    # -----------------

    def begin_step(self, t: float) -> None:
        """Take requests and changes of hands at the time t [s] of a step."""
        self._t = t
        while self._requests:
            what, value = self._requests.popleft()
            try:
                self._take_request(t, what, value)
            except InputError as error:
                self._publisher.text("error", text=str(error))
        self._hands_events(t)

    def _take_request(self, t: float, what: str, value: Any) -> None:
        if what == "pause":
            self._event(t, "pause", {"on": bool(value)})
            self._say(t, "pause", "The class is paused." if value else "The class goes on.")
        elif what == "speed":
            self._event(t, "speed", {"value": self.clock.speed})
            self._say(t, "speed", f"Time runs at {self.clock.speed:g} of real time.")
        elif what == "effect":
            self._switch(t, *value)
        elif what in ("restart", "again"):
            self._event(t, "restart", {})
            self._stop_reason, self._repeat_seed = "the same start again", True
        elif what == "task":
            self._task = make_task(*value)
            self._stop_reason = "another task"
        elif what == "record":
            self.recording = bool(value)
            self._say(t, "record", "Logs are kept." if value else "Old logs are removed again.")
        elif what == "ignored":
            self._event(t, "sticks ignored", {"name": value})
            self._say(t, "sticks ignored", f"{value} moved the sticks without being asked to fly.")
        elif what == "end":
            self._stop_reason = "the class ends"

    def _switch(self, t: float, name: str, on: bool) -> None:
        """Switch an effect of the catalogue on or off, in flight."""
        if on == (name in self._active):
            return
        if on:
            self._active[name] = draw_effect(name, self._trial.seed + len(self._active))
        parameters = self._active[name] if on else self._active.pop(name)
        try:
            self._trial.world.change_model(self.model)
        except InputError:
            self._active.pop(name, None)
            raise
        self._event(t, "effect", {"name": name, "on": on, "parameters": parameters})
        sizes = ", ".join(f"{key} {value:.3g}" for key, value in parameters.items())
        word = f"{name.replace('_', ' ')} is on ({sizes})" if on else f"{name} is off"
        self._say(t, "effect", f"The effect {word}.")
        self._publisher.text("effects", active=self.active_effects)

    def _start_effects(self) -> None:
        """Effects that are on when a flight begins."""
        if not self._active:
            return
        self._trial.world.change_model(self.model)
        for name, parameters in self._active.items():
            self._event(0.0, "effect", {"name": name, "on": True, "parameters": parameters})

    def _hands_events(self, t: float) -> None:
        for event in self.hands.events():
            details = {"holder": event.holder, "name": event.name, "reason": event.reason}
            self._event(t, "hands", details)
            if event.holder == "student" and event.name not in self._names:
                self._names.append(event.name)
            self._publisher.text(
                "who", holder=event.holder, name=event.name, client=event.client,
                reason=event.reason,
            )  # fmt: skip
            self._say(t, "hands", f"{event.holder.capitalize()}: {event.reason}.")

    def _event(self, t: float, name: str, details: Any) -> None:
        """Log an event; a full disk does not end the flight."""
        if self.log is not None:
            with suppress(InputError):
                self.log.event(t, name, details)

    def _say(self, t: float, name: str, text: str) -> None:
        self._publisher.text("event", t=t, flight=self.flight_number, name=name, text=text)

    def _publish_flight(self, trial: TrialSetup) -> None:
        self._publisher.text(
            "flight", number=self.flight_number, task=settings_task(self._task),
            manoeuvre=self._manoeuvre_name(), seed=trial.seed, pilot=self.settings.pilot,
            start={"t": 0.0}, phases=list(PHASES), effects=self.active_effects,
        )  # fmt: skip

    def _show(self, step: LoopStep) -> None:
        """Publish a step: the true state, as simulated."""
        now = time.perf_counter()
        self._step_times.append(now)
        truth = self._trial.world.state
        self._last_state = self._pack(step, truth, 0)
        self._publisher.state(self._last_state)
        self._publisher.step(self, step, truth)
        self._last_step = (step, truth)

    def _pack(self, step: LoopStep, truth: State, flags: int) -> bytes:
        now = time.perf_counter()
        recent = [at for at in self._step_times if now - at <= 1.0]
        spent = recent[-1] - recent[0] if len(recent) > 1 else 0.0
        rate = (len(recent) - 1) / spent if spent > 0.0 else 0.0
        flags |= channel.STRETCHED * (self.clock.stretch() > STRETCH)
        flags |= channel.PAUSED * self.clock.paused | channel.PORT * bool(self.settings.port)
        flags |= channel.ASSIST * self.hands.assisted
        phase = PHASES.index(step.mode) if step.mode in PHASES else 0
        return channel.pack_state(
            flags=flags, holder=self.hands.holder, phase=phase, flight=self.flight_number,
            step=round(step.t / CONTROL_PERIOD_S), t=step.t, state=truth, command=step.command,
            leader=step.leader, rate_hz=rate, speed=self.clock.speed,
        )  # fmt: skip

    def _while_paused(self) -> None:
        """Called while time stands still."""
        self.hands.tick()
        self._hands_events(self._t)
        self._resend(0)
        if any(what in ("restart", "again", "task", "end") for what, _ in self._requests):
            self.clock.paused = False

    def _resend(self, flags: int) -> None:
        if self._last_step is not None:
            self._publisher.state(self._pack(*self._last_step, flags))

    def _rest(self, seconds: float) -> None:
        """Wait after a flight, or until the next is asked for."""
        end = time.monotonic() + seconds
        while time.monotonic() < end and not self._ended.is_set():
            if any(what in ("restart", "again", "task") for what, _ in self._requests):
                for what, value in list(self._requests):
                    if what == "task":
                        self._task = make_task(*value)
                    self._repeat_seed |= what in ("restart", "again")
                self._requests.clear()
                return
            self._idle()

    def _idle(self, flags: int = channel.OVER) -> None:
        self._ended.wait(IDLE_PERIOD_S)
        self.hands.tick()
        self._hands_events(self._t)
        self._resend(flags)

    def _forget_old_logs(self) -> None:
        """Remove the oldest logs beyond the limit, but none that was recorded."""
        others = [path for path, kept in self._logs if not kept]
        for path in others[: max(len(others) - self.settings.keep, 0)]:
            with suppress(OSError):
                path.unlink()
            self._logs.remove((path, False))


class ClassPilot:
    """The loop's pilot: the student where one holds the sticks, else the autopilot or none."""

    def __init__(
        self, session: Session, trial: TrialSetup, make: Callable[[bool], Pilot] | None
    ) -> None:
        self.mode, self._session, self._trial, self._make = "", session, trial, make
        self._autopilot = None if make is None else make(False)
        self.student_flies = False  # in the present step

    def act(self, observation: Observation) -> Command:
        """The command of whoever holds the sticks."""
        session = self._session
        truth = self._trial.world.state
        session.hands.tick(envelope_problem(truth, is_landing=self._trial.leader is None))
        session.begin_step(observation.t)
        if session.hands.holder == "student":
            self.student_flies = True
            self.mode = ASSISTED if session.hands.assisted else STUDENT
            return session.hands.command(observation)
        if self._make is None or self._autopilot is None:
            self.mode = SAFE
            return SAFE_COMMAND
        if self.student_flies:
            self.student_flies = False
            self._autopilot = self._make(True)
        command = self._autopilot.act(observation)
        self.mode = str(getattr(self._autopilot, "mode", ""))
        return command


def make_task(task: str, manoeuvre: str = "") -> Any:
    """A task of the table; InputError where there is none of that name or manoeuvre."""
    if task not in TASKS:
        raise InputError(f"task: expected one of {', '.join(TASKS)}, got {str(task)[:40]!r}")
    entry = TASKS[task]
    return entry.make(manoeuvre or FOLLOWED) if entry.manoeuvre else entry.make()


def settings_task(task: FlightTask) -> str:
    """The task's name without its manoeuvre."""
    return task.name.split()[0]


def replace_duration(trial: TrialSetup, task: FlightTask) -> TrialSetup:
    """The trial with time for laps, where there is no leader whose flight ends."""
    return trial if trial.leader is not None else replace(trial, duration=LONGEST_FLIGHT_S)


def class_effects() -> list[Effect]:
    """The effects of the catalogue that can be switched on: those with sizes, one for each name."""
    found: dict[str, Effect] = {}
    for effect in CATALOGUE:
        if effect.sizes and effect.draw:
            found.setdefault(effect.name, effect)
    return list(found.values())


def draw_effect(name: str, seed: int) -> dict[str, float]:
    """Parameters of an effect at its plainly visible size, its direction from the seed.

    Raises:
        InputError: there is no such effect.
    """
    for effect in class_effects():
        if effect.name == name and effect.sizes and effect.draw:
            return effect.draw(np.random.default_rng([seed, 7]), effect.sizes[2])
    names = ", ".join(effect.name for effect in class_effects())
    raise InputError(f"effect: expected one of {names}, got {str(name)[:40]!r}")
