"""The loop: images and states in, commands out at 20 Hz; the same in simulation and on hardware.

Only its sources, its sink and its clock change. If a pilot fails, the aircraft receives the safe
command (neutral, motor idle) and never an exception; it receives the same at the end of a flight.
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
from falconwing_kit.core.messages import (
    CONTROL_PERIOD_S,
    SAFE_COMMAND,
    Command,
    Event,
    Image,
    Observation,
    State,
)

HISTORY = 30  # past commands in an observation, as in the paper
MAX_LATENESS = 0.5  # of a step, in periods; so two steps are never closer than this


class ImageSource(Protocol):
    """Source of images: a camera, a renderer or a log."""

    def next_image(self, t: float) -> Image | None:
        """The newest image at time t [s]; None before the first, an exception after the last."""


class StateSource(Protocol):
    """Source of states: a simulated world, a log, a leader's path or an estimator."""

    def state_at(self, t: float) -> State | None:
        """The state at time t [s]; None where it is unknown."""


class CommandSink(Protocol):
    """Destination of commands: a simulated world or the trainer port."""

    def send(self, t: float, command: Command) -> Command | None:
        """Send a command at time t [s]; it is held until the next one.

        Returns:
            What acts in its place, as where a person still flies; None: the command itself.
        """


class Pilot(Protocol):
    """A controller; an optional `mode` string is logged, and so is an optional `state`, its own
    estimate, where the loop has no source of states.
    """

    def act(self, observation: Observation) -> Command:
        """The command for this moment."""


class StepSupervisor(Protocol):
    """What the loop needs of a `flight.supervisor.Supervisor`."""

    @property
    def record(self) -> Mapping[str, Any]:
        """Limits and reason, for the log."""

    def see(self, image: Image, t: float) -> None:
        """Take note of a new image."""

    def check(self, t: float, command: Command | None, state: State | None, pilot_s: float) -> str:
        """Why control must be handed back; empty to go on."""


class Clock(Protocol):
    """Time base of the loop."""

    def start(self) -> None:
        """Set the time to zero."""

    def now(self) -> float:
        """Time since the start [s]."""

    def wait_until(self, t: float) -> None:
        """Return at time t [s], or immediately if it has passed."""


class WallClock:
    """Real time."""

    def start(self) -> None:
        """Set the time to zero."""
        self._zero = time.perf_counter()

    def now(self) -> float:
        """Time since the start [s]."""
        return time.perf_counter() - self._zero

    def wait_until(self, t: float) -> None:
        """Sleep until time t [s]."""
        time.sleep(max(0.0, t - self.now()))


class SimulatedClock:
    """Simulated time: it advances only when the loop waits, so the loop runs as fast as it can."""

    def start(self) -> None:
        """Set the time to zero."""
        self._t = 0.0

    def now(self) -> float:
        """Time since the start [s]."""
        return self._t

    def wait_until(self, t: float) -> None:
        """Advance to time t [s]."""
        self._t = max(self._t, t)


class PacedClock:
    """Real time, or `speed` times it, without dropped steps: late steps delay all that follow.

    A flight is therefore the same on every machine.
    """

    def __init__(self, speed: float = 1.0) -> None:
        self._speed = speed

    def start(self) -> None:
        """Set the time to zero."""
        self._t, self._deadline_offset = 0.0, time.perf_counter()

    def now(self) -> float:
        """Time of the flight [s]; constant between two steps."""
        return self._t

    def wait_until(self, t: float) -> None:
        """Sleep until time t [s]; a late step shifts all that follow."""
        self._deadline_offset = max(
            self._deadline_offset + (t - self._t) / self._speed, time.perf_counter()
        )
        time.sleep(max(0.0, self._deadline_offset - time.perf_counter()))
        self._t = max(self._t, t)


@dataclass(frozen=True)
class LoopStep:
    """One step, for hooks."""

    t: float  # [s]
    image: Image | None  # the newest one
    state: State | None  # as the pilot got it; without a source of states, as it estimated it
    command: Command  # as sent
    mode: str  # the pilot's `mode`; empty where it has none
    leader: State | None  # the leader's state, for tasks with one


@dataclass(frozen=True, eq=False)
class LoopResult:
    """End and timing of a flight."""

    # "duration", "interrupted", "pilot failed", "handed back", or the reason of the stop condition
    reason: str
    t: Array  # (n,) deadlines of the steps flown [s]
    lateness: Array  # (n,) start of each step after its deadline [s]
    skipped: int  # steps left out because they were too late
    # (n,) real time of each stage [s]: images, states, pilot, send, log, hooks
    seconds: Mapping[str, Array]
    events: tuple[Event, ...]

    @property
    def faults(self) -> int:
        """Steps in which the pilot failed and the safe command was sent."""
        return sum(event.name == "pilot failed" for event in self.events)

    @property
    def rate_hz(self) -> float:
        """Steps flown per second; nan for fewer than two."""
        return (len(self.t) - 1) / float(self.t[-1] - self.t[0]) if len(self.t) > 1 else math.nan

    def milliseconds(self, stage: str) -> tuple[float, float]:
        """Median and 95th percentile of a stage, or of "lateness" [ms]; nan for no steps."""
        values = self.lateness if stage == "lateness" else self.seconds.get(stage, np.zeros(0))
        if len(values) == 0:
            return math.nan, math.nan
        median, high = np.percentile(1e3 * values, (50.0, 95.0))
        return float(median), float(high)


def deadlines(
    clock: Clock, duration: float, period: float = CONTROL_PERIOD_S
) -> Iterator[tuple[int, float]]:
    """Wait for the deadlines k * period, one after the other.

    Deadlines are absolute, so waiting errors do not accumulate. A step up to half a period late
    runs immediately; a later one is skipped, never executed in a burst with the next.

    Args:
        clock: already started.
        duration: no deadline at or after this time [s].
        period: [s].

    Yields:
        k, and its lateness [s].
    """
    k = 0
    while k * period < duration:
        clock.wait_until(k * period)
        yield k, clock.now() - k * period
        k = max(k + 1, math.ceil(clock.now() / period - MAX_LATENESS))


@dataclass
class Loop:
    """One flight: sources, a pilot, a sink, a clock, a log and hooks; `run` flies it.

    If a pilot raises or returns anything but a finite command, the safe command is sent in that
    step and an event logged. A hook, a `mode` or a log that fails is dropped, and the flight goes
    on. If a source or sink raises, the flight ends and the error is raised. If the supervisor finds
    a fault, the safe command is sent in place of the pilot's, a sink with `hand_back` returns
    control, and the flight ends. However a flight ends, the safe command is the last one given to
    the sink.
    """

    pilot: Pilot
    sink: CommandSink
    images: ImageSource | None = None
    states: StateSource | None = None
    leader: StateSource | None = None  # for hooks only; the pilot has to find it in the images
    clock: Clock = field(default_factory=SimulatedClock)
    log: FlightLogWriter | None = None  # opened and closed by the caller
    hooks: Sequence[Callable[[LoopStep], None]] = ()
    supervisor: StepSupervisor | None = None  # None: the pilot alone decides, as when it is judged
    period: float = CONTROL_PERIOD_S  # [s]
    faults_allowed: int = 20  # consecutive steps without a command before the flight ends: 1 s

    def run(
        self, duration: float, stop_condition: Callable[[LoopStep], str] = lambda step: ""
    ) -> LoopResult:
        """Fly until the duration [s], a stop condition or Ctrl-C; then send the safe command.

        Args:
            duration: maximum duration [s].
            stop_condition: called after every step; a non-empty reason ends the flight.

        Raises:
            InputError: duration or period is not positive.
            Exception: raised by a source, the sink or stop_condition.
        """
        require_range("duration", duration, low=1e-6, high=1e6)
        require_range("period", self.period, low=1e-4, high=10.0)
        run, reason = _Run(self), "duration"
        self.clock.start()
        try:
            with _catch_ctrl_c() as interrupted:
                for k, lateness in deadlines(self.clock, duration, self.period):
                    stop_reason = stop_condition(run.step(k * self.period, lateness))
                    if interrupted.is_set():
                        raise KeyboardInterrupt
                    if run.handed_back:
                        reason = "handed back"
                        break
                    if stop_reason or run.consecutive_faults > self.faults_allowed:
                        reason = stop_reason or "pilot failed"
                        break
                else:
                    self.clock.wait_until(duration)  # the last command is held to the end
                run.send_safe_command()
        except KeyboardInterrupt:
            run.abort(reason := "interrupted", "Ctrl-C")
        except Exception as flight_error:
            run.abort("failed", _error_text(flight_error))
            raise
        if self.supervisor is not None and not run.handed_back:
            run.add_event("supervisor", self.supervisor.record)
        run.add_event("ended", {"reason": reason, "steps": len(run.times), "skipped": run.skipped})
        return run.result(reason)


class _Run:
    """The changing state of a running loop."""

    def __init__(self, loop: Loop) -> None:
        self.loop, self.log, self.hooks = loop, loop.log, list(loop.hooks)
        self.image: Image | None = None
        self.past_commands = np.zeros((HISTORY, 4))
        self.times: list[float] = []
        self.lateness: list[float] = []
        self.seconds: dict[str, list[float]] = defaultdict(list)
        self.events: list[Event] = []
        self.consecutive_faults = 0
        self.handed_back = False
        self.mode, self.mode_failed = "", False

    def step(self, t: float, lateness: float) -> LoopStep:
        """Get image and state, ask the pilot, send; log and call hooks only after that."""
        loop, last_image = self.loop, self.image
        self.times.append(t)
        self.lateness.append(lateness)
        with self.time_stage("images"):
            image = loop.images.next_image(t) if loop.images else None
        is_new = image is not None and (last_image is None or image.sequence != last_image.sequence)
        if is_new:
            self.image = image
            if loop.supervisor is not None and image is not None:
                loop.supervisor.see(image, t)
        with self.time_stage("states"):
            state = loop.states.state_at(t) if loop.states else None
        observation = Observation(t, self.image, self.past_commands, state)
        with self.time_stage("pilot"):
            command = self.request_command(observation)
        command = self.supervise(t, command, state)
        with self.time_stage("send"):
            sent = loop.sink.send(t, command)
        if sent is not None:
            command = replace(sent, image_sequence=command.image_sequence)
        self.past_commands = np.vstack([self.past_commands[1:], command.vector])
        if loop.states is None:
            state = self.read_estimate()
        leader = loop.leader.state_at(t) if loop.leader else None
        step = LoopStep(t, self.image, state, command, self.read_mode(), leader)
        with self.time_stage("log"):
            self.write_step(step, self.image if is_new else None)
        with self.time_stage("hooks"):
            self.call_hooks(step)
        return step

    def request_command(self, observation: Observation) -> Command:
        """The pilot's command within its limits, or the safe one."""
        sequence = -1 if observation.image is None else observation.image.sequence
        try:
            answer = self.loop.pilot.act(observation)
            if not isinstance(answer, Command):
                raise TypeError(f"expected a Command, got {type(answer).__name__}")
            command = Command.clip(*answer.vector.tolist())
        except Exception as pilot_error:
            self.consecutive_faults += 1
            self.add_event("pilot failed", {"error": _error_text(pilot_error)})
            return replace(SAFE_COMMAND, image_sequence=sequence)
        self.consecutive_faults = 0
        saturated = command.saturated or bool(answer.saturated)
        return replace(command, image_sequence=sequence, saturated=saturated)

    def supervise(self, t: float, command: Command, state: State | None) -> Command:
        """The command, or the safe one with the first fault that the supervisor finds."""
        supervisor, sink = self.loop.supervisor, self.loop.sink
        if supervisor is None:
            return command
        judged = None if self.consecutive_faults else command
        if not supervisor.check(t, judged, state, self.seconds["pilot"][-1]):
            return command
        self.handed_back = True
        hand_back = getattr(sink, "hand_back", None)
        if hand_back is not None:
            hand_back()
        self.add_event("handed back", supervisor.record)
        return replace(SAFE_COMMAND, image_sequence=command.image_sequence)

    def read_mode(self) -> str:
        """The pilot's `mode`; empty after the first time that reading it raised."""
        if self.mode_failed:
            return ""
        try:
            return str(getattr(self.loop.pilot, "mode", ""))
        except Exception as mode_error:
            self.mode_failed = True
            self.add_event("mode dropped", {"error": _error_text(mode_error)})
            return ""

    def read_estimate(self) -> State | None:
        """The pilot's own estimate of the state, for log and hooks; None where it has none."""
        try:
            estimate = getattr(self.loop.pilot, "state", None)
        except Exception:
            return None
        return estimate if isinstance(estimate, State) else None

    def write_step(self, step: LoopStep, new_image: Image | None) -> None:
        """Log a step, the command first: if the disk fills up, the command is the part to have."""
        if new_image is not None and new_image.t < 0.0:  # a camera runs before the loop does
            new_image = replace(new_image, t=0.0)

        def write(log: FlightLogWriter) -> None:
            log.command(self.loop.clock.now(), step.command, new_image)
            if step.state is not None:
                log.state(step.t, step.state, step.command.image_sequence)
            if step.leader is not None:
                log.leader(step.t, step.leader)

        self.write(write)
        if step.mode != self.mode:
            self.add_event("mode", {"mode": step.mode})
            self.mode = step.mode

    def call_hooks(self, step: LoopStep) -> None:
        """Call the hooks; one that raises is not called again."""
        for hook in list(self.hooks):
            try:
                hook(step)
            except Exception as hook_error:
                self.hooks.remove(hook)
                name = getattr(hook, "__qualname__", str(hook))
                self.add_event("hook dropped", {"hook": name, "error": _error_text(hook_error)})

    def abort(self, name: str, why: str) -> None:
        """Send the safe command after an error or Ctrl-C; a failure here must not hide it."""
        with suppress(Exception):
            self.send_safe_command()
        self.add_event(name, {"why": why})

    def send_safe_command(self) -> None:
        """Send and log the safe command; the sink holds the last command indefinitely."""
        sent = self.loop.sink.send(self.loop.clock.now(), SAFE_COMMAND) or SAFE_COMMAND
        self.write(lambda log: log.command(self.loop.clock.now(), sent))

    def add_event(self, name: str, details: Mapping[str, Any]) -> None:
        """Record and log an event."""
        event = Event(self.loop.clock.now(), name, details)
        self.events.append(event)
        self.write(lambda log: log.event(event.t, event.name, event.details))

    def write(self, what: Callable[[FlightLogWriter], None]) -> None:
        """Write to the log; if that fails, go on without a log."""
        if self.log is None:
            return
        try:
            what(self.log)
        except InputError as log_error:
            self.log = None
            warn(f"{log_error}; the flight goes on without a log", stacklevel=2)

    @contextmanager
    def time_stage(self, stage: str) -> Iterator[None]:
        """Add the real time of a block to its stage."""
        begin = time.perf_counter()
        yield
        self.seconds[stage].append(time.perf_counter() - begin)

    @property
    def skipped(self) -> int:
        """Deadlines between the first and the last step that were not flown."""
        return round(self.times[-1] / self.loop.period) + 1 - len(self.times) if self.times else 0

    def result(self, reason: str) -> LoopResult:
        """The record of the flight."""
        times, lateness = np.array(self.times), np.array(self.lateness)
        seconds = {stage: np.array(values) for stage, values in self.seconds.items()}
        return LoopResult(reason, times, lateness, self.skipped, seconds, tuple(self.events))


@contextmanager
def _catch_ctrl_c() -> Iterator[threading.Event]:
    """An event that the first Ctrl-C sets, so no log record is cut; the second one raises."""
    interrupted = threading.Event()

    def handle(signal_number: int, frame: Any) -> None:
        if interrupted.is_set():
            raise KeyboardInterrupt
        interrupted.set()

    is_main_thread = threading.current_thread() is threading.main_thread()
    if not is_main_thread or signal.getsignal(signal.SIGINT) is not signal.default_int_handler:
        yield interrupted  # another handler is installed already
        return
    signal.signal(signal.SIGINT, handle)
    try:
        yield interrupted
    finally:
        signal.signal(signal.SIGINT, signal.default_int_handler)


def _error_text(error: BaseException) -> str:
    return f"{type(error).__name__}: {error}"
