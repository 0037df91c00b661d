"""The loop: images and states in, commands out, 20 times a second; the same loop for simulation and
hardware.

Only its two ends change: where images and states come from, and where commands go. Whatever goes
wrong in a pilot, the aircraft gets neutral sticks and an idle motor instead of an exception; and so
it does when the flight is over.
"""

import math
import signal
import threading
import time
from collections import defaultdict
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field, replace
from typing import Any, Protocol
from warnings import warn

import numpy as np

from falconwing_kit.core.checks import Array, InputError, require_range
from falconwing_kit.core.flight_log import FlightLogWriter
from falconwing_kit.core.messages import Command, Event, Image, Observation, State

CONTROL_PERIOD = 0.05  # s: the paper's 20 Hz
HISTORY = 30  # past commands that a pilot sees, as in the paper
SAFE_COMMAND = Command(throttle=0.0, aileron=0.0, elevator=0.0, rudder=0.0)
MAX_LATENESS = (
    0.5  # periods: a step later than this is skipped, so that two steps are never closer than this
)


class ImageSource(Protocol):
    """Where images come from."""

    def next(self, t: float) -> Image | None:
        """The newest image at time t [s]; None where there is none, an exception where there will
        be none again.
        """


class StateSource(Protocol):
    """Where states come from: a simulated world, later vision; a leader's path is one too."""

    def state(self, t: float) -> State | None:
        """The state at time t [s]; None where it is not known."""


class CommandSink(Protocol):
    """Where commands go."""

    def send(self, t: float, command: Command) -> None:
        """Give a command at time t [s]; it holds until the next."""


class Pilot(Protocol):
    """Who flies. A pilot with a word in `mode` shows it."""

    def act(self, observation: Observation) -> Command:
        """The command for this moment."""


class Clock(Protocol):
    """What the loop is scheduled against."""

    def start(self) -> None:
        """Now is zero."""

    def now(self) -> float:
        """Time since the start [s]."""

    def wait_until(self, t: float) -> None:
        """Return at time t [s], at once if it has passed."""


class WallClock:
    """Real time."""

    def start(self) -> None:
        """Now is zero."""
        self._zero = time.perf_counter()

    def now(self) -> float:
        """Time since the start [s]."""
        return time.perf_counter() - self._zero

    def wait_until(self, t: float) -> None:
        """Sleep until time t [s]."""
        time.sleep(max(0.0, t - self.now()))


class SimulatedClock:
    """Time that passes only where the loop waits for it: as fast as it can."""

    def start(self) -> None:
        """Now is zero."""
        self._t = 0.0

    def now(self) -> float:
        """Time since the start [s]."""
        return self._t

    def wait_until(self, t: float) -> None:
        """Time t [s] is there at once."""
        self._t = max(self._t, t)


@dataclass(frozen=True)
class LoopStep:
    """What happened in one step, for hooks."""

    t: float  # [s]
    image: Image | None  # the newest one
    state: State | None  # as the pilot saw it
    command: Command  # as it was sent
    mode: str  # what the pilot says it is doing; empty where it says nothing
    leader: State | None  # where the leader is, for tasks with one


@dataclass(frozen=True, eq=False)
class LoopResult:
    """How the loop went."""

    reason: (
        str  # why it ended: "duration", "interrupted", "pilot failed", or the word of what ended it
    )
    t: Array  # (n,) deadlines of the steps flown [s]
    lateness: Array  # (n,) by which each step began after its deadline [s]
    skipped: int  # steps that were too late to fly
    seconds: Mapping[
        str, Array
    ]  # (n,) for each stage: images, states, pilot, send, log, hooks [s of real time]
    events: tuple[Event, ...]

    @property
    def faults(self) -> int:
        """Steps in which the pilot failed and the safe command was sent."""
        return sum(event.name == "pilot failed" for event in self.events)

    @property
    def rate_hz(self) -> float:
        """Steps a second, skipped ones missing; nan for fewer than two."""
        return (len(self.t) - 1) / float(self.t[-1] - self.t[0]) if len(self.t) > 1 else math.nan

    def milliseconds(self, stage: str) -> tuple[float, float]:
        """Median and 95th percentile of a stage [ms]; "lateness" gives the jitter of the schedule.
        nan for no steps.
        """
        values = self.lateness if stage == "lateness" else self.seconds.get(stage, np.zeros(0))
        if len(values) == 0:
            return math.nan, math.nan
        median, high = np.percentile(1e3 * values, (50.0, 95.0))
        return float(median), float(high)


def deadlines(
    clock: Clock, duration: float, period: float = CONTROL_PERIOD
) -> Iterator[tuple[int, float]]:
    """Wait for one deadline k * period after the other; they are absolute, so errors of waiting
    never add up.

    A step that is late by up to half a period is flown at once. What is later is left out, and the
    next deadline is waited for: steps are never made up for in a burst.

    Args:
        clock: already started.
        duration: no deadline at or after this time [s].
        period: [s].

    Yields:
        k, and how late it is [s].
    """
    k = 0
    while k * period < duration:
        clock.wait_until(k * period)
        yield k, clock.now() - k * period
        k = max(k + 1, math.ceil(clock.now() / period - MAX_LATENESS))


@dataclass
class Loop:
    """One flight: sources, a pilot, a sink, a clock, a log and hooks; `run` flies it.

    A pilot that raises or answers with something else than finite sticks costs the step: the safe
        command is sent and
    an event logged. A hook that raises is dropped, a log whose disk is full and a pilot's `mode` as
    well, and the flight goes on. A source or sink that raises ends the flight and the error is
    raised. However a flight ends, the safe command is the last one sent.
    """

    pilot: Pilot
    sink: CommandSink
    images: ImageSource | None = None
    states: StateSource | None = None
    leader: StateSource | None = None  # only shown to hooks; the pilot has to see it
    clock: Clock = field(default_factory=SimulatedClock)
    log: FlightLogWriter | None = None  # opened and closed by the caller
    hooks: Sequence[Callable[[LoopStep], None]] = ()
    period: float = CONTROL_PERIOD  # [s]
    faults_allowed: int = 20  # steps in a row without a command before the flight ends: one second

    def run(
        self, duration: float, ended: Callable[[LoopStep], str] = lambda step: ""
    ) -> LoopResult:
        """Fly until something ends it, Ctrl-C too; then send the safe command.

        Args:
            duration: at most so long [s].
            ended: asked after every step; a word ends the flight, an empty one does not.

        Returns:
            How it went.

        Raises:
            InputError: duration or period is not positive.
            Exception: whatever a source, the sink or `ended` raised.
        """
        require_range("duration", duration, low=1e-6, high=1e6)
        require_range("period", self.period, low=1e-4, high=10.0)
        run, reason = _Run(self), "duration"
        self.clock.start()
        try:
            with _ctrl_c() as stop_requested:
                for k, lateness in deadlines(self.clock, duration, self.period):
                    stop_reason = ended(run.step(k * self.period, lateness))
                    if stop_requested.is_set():
                        raise KeyboardInterrupt
                    if stop_reason or run.faults_in_a_row > self.faults_allowed:
                        reason = stop_reason or "pilot failed"
                        break
                else:
                    self.clock.wait_until(duration)  # the last step's command holds to its end
                run.send_safe_command()
        except KeyboardInterrupt:
            run.abort(reason := "interrupted", "Ctrl-C")
        except Exception as error:
            run.abort("failed", _error_text(error))
            raise
        run.event("ended", {"reason": reason, "steps": len(run.times), "skipped": run.skipped})
        return run.flight(reason)


class _Run:
    """What changes while a loop runs."""

    def __init__(self, loop: Loop) -> None:
        self.loop, self.log, self.hooks = loop, loop.log, list(loop.hooks)
        self.image: Image | None = None
        self.past_commands = np.zeros((HISTORY, 4))
        self.times: list[float] = []
        self.lateness: list[float] = []
        self.seconds: dict[str, list[float]] = defaultdict(list)
        self.events: list[Event] = []
        self.faults_in_a_row = 0
        self.mode, self.mode_failed = "", False

    def step(self, t: float, lateness: float) -> LoopStep:
        """Look, ask the pilot, send, and only then log and show."""
        loop = self.loop
        self.times.append(t)
        self.lateness.append(lateness)
        with self.time_stage("images"):
            new_image = loop.images.next(t) if loop.images else None
        if (
            new_image is not None
            and self.image is not None
            and new_image.sequence == self.image.sequence
        ):
            new_image = None
        self.image = new_image or self.image
        with self.time_stage("states"):
            state = loop.states.state(t) if loop.states else None
        observation = Observation(t, self.image, self.past_commands, state)
        with self.time_stage("pilot"):
            command = self.ask(observation)
        with self.time_stage("send"):
            loop.sink.send(t, command)
        self.past_commands = np.vstack([self.past_commands[1:], command.vector])
        leader = loop.leader.state(t) if loop.leader else None
        step = LoopStep(t, self.image, state, command, self.read_mode(), leader)
        with self.time_stage("log"):
            self.write(lambda log: _log_step(log, loop.clock.now(), step, new_image))
            if step.mode != self.mode:
                self.event("mode", {"mode": step.mode})
                self.mode = step.mode
        with self.time_stage("hooks"):
            self.call_hooks(step)
        return step

    def ask(self, observation: Observation) -> Command:
        """The pilot's command within its limits, or the safe one."""
        sequence = -1 if observation.image is None else observation.image.sequence
        try:
            answer = self.loop.pilot.act(observation)
            if not isinstance(answer, Command):
                raise TypeError(f"expected a Command, got {type(answer).__name__}")
            command = Command.clip(*answer.vector.tolist())
        except Exception as error:
            self.faults_in_a_row += 1
            self.event("pilot failed", {"error": _error_text(error)})
            return replace(SAFE_COMMAND, image_sequence=sequence)
        self.faults_in_a_row = 0
        return replace(
            command, image_sequence=sequence, saturated=command.saturated or bool(answer.saturated)
        )

    def read_mode(self) -> str:
        """The pilot's word for what it is doing; where asking raises, it is not asked again."""
        if self.mode_failed:
            return ""
        try:
            return str(getattr(self.loop.pilot, "mode", ""))
        except Exception as error:
            self.mode_failed = True
            self.event("mode dropped", {"error": _error_text(error)})
            return ""

    def call_hooks(self, step: LoopStep) -> None:
        """Call the hooks; one that raises is not called again."""
        for hook in list(self.hooks):
            try:
                hook(step)
            except Exception as error:
                self.hooks.remove(hook)
                self.event(
                    "hook dropped",
                    {"hook": getattr(hook, "__qualname__", str(hook)), "error": _error_text(error)},
                )

    def abort(self, name: str, why: str) -> None:
        """Let go before an error or Ctrl-C ends the flight; what fails here must not hide the
        reason.
        """
        with suppress(Exception):
            self.send_safe_command()
        self.event(name, {"why": why})

    def send_safe_command(self) -> None:
        """The safe command, for what was sent last holds for ever."""
        self.loop.sink.send(self.loop.clock.now(), SAFE_COMMAND)
        self.write(lambda log: log.command(self.loop.clock.now(), SAFE_COMMAND))

    def event(self, name: str, details: Mapping[str, Any]) -> None:
        """Note and log an event."""
        event = Event(self.loop.clock.now(), name, details)
        self.events.append(event)
        self.write(lambda log: log.event(event.t, event.name, event.details))

    def write(self, what: Callable[[FlightLogWriter], None]) -> None:
        """Write to the log; where it cannot be written, fly on without."""
        if self.log is None:
            return
        try:
            what(self.log)
        except InputError as error:
            self.log = None
            warn(f"{error}; the flight goes on without a log", stacklevel=2)

    @contextmanager
    def time_stage(self, stage: str) -> Iterator[None]:
        """Add the real time that a block takes to its stage."""
        begin = time.perf_counter()
        yield
        self.seconds[stage].append(time.perf_counter() - begin)

    @property
    def skipped(self) -> int:
        """Deadlines between the first and the last step that were not flown."""
        return round(self.times[-1] / self.loop.period) + 1 - len(self.times) if self.times else 0

    def flight(self, reason: str) -> LoopResult:
        """The record of the flight."""
        seconds = {stage: np.array(values) for stage, values in self.seconds.items()}
        return LoopResult(
            reason,
            np.array(self.times),
            np.array(self.lateness),
            self.skipped,
            seconds,
            tuple(self.events),
        )


@contextmanager
def _ctrl_c() -> Iterator[threading.Event]:
    """Ctrl-C asks for an end after the step, so that it cuts no record of the log; a second one
    does not wait.
    """
    stop_event = threading.Event()

    def ask(signal_number: int, frame: Any) -> None:
        if stop_event.is_set():
            raise KeyboardInterrupt
        stop_event.set()

    is_main_thread = threading.current_thread() is threading.main_thread()
    if not is_main_thread or signal.getsignal(signal.SIGINT) is not signal.default_int_handler:
        yield stop_event  # somebody else minds Ctrl-C
        return
    signal.signal(signal.SIGINT, ask)
    try:
        yield stop_event
    finally:
        signal.signal(signal.SIGINT, signal.default_int_handler)


def _log_step(log: FlightLogWriter, now: float, step: LoopStep, new_image: Image | None) -> None:
    """The command first: if the disk fills up in between, it is the one to have."""
    log.command(now, step.command, new_image)
    if step.state is not None:
        log.state(step.t, step.state, step.command.image_sequence)


def _error_text(error: BaseException) -> str:
    return f"{type(error).__name__}: {error}"
