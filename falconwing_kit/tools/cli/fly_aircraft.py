"""`falconwing fly --port P --source camera`: a pilot by images -> a real aircraft, supervised.

The same loop and supervisor as in simulation; only camera, board and clock are real. A person holds
the radio and its trainer switch, which always takes the aircraft back, and flies until the operator
at the computer presses Enter: only then is the board asked to follow.
"""

import json
import sys
import threading
import time
from collections.abc import Callable, Mapping
from contextlib import ExitStack, suppress
from dataclasses import asdict, dataclass, replace
from typing import TYPE_CHECKING, Any

from falconwing_kit.core.checks import InputError, require_range
from falconwing_kit.core.messages import SAFE_COMMAND, Command, State
from falconwing_kit.flight.loop import Loop, LoopResult, LoopStep, WallClock
from falconwing_kit.flight.pilots import PILOTS
from falconwing_kit.flight.supervisor import Supervisor, SupervisorSettings
from falconwing_kit.tools.cli.board_status import (
    StatusLine,
    alert,
    open_ready_port,
    pilot_sticks,
)
from falconwing_kit.tools.cli.calibrate import SIMULATED_PORTS, choose_calibration
from falconwing_kit.tools.cli.show import next_line, print_json, print_table
from falconwing_kit.trainer_port.port import TrainerPort
from falconwing_kit.vision.monitor import FrameMonitor

if TYPE_CHECKING:
    from falconwing_kit.core.flight_log import FlightLogWriter
    from falconwing_kit.flight.loop import ImageSource
    from falconwing_kit.scene.camera import PinholeCamera
    from falconwing_kit.tools.cli.fly import Fly
    from falconwing_kit.tools.devices.calibration import BenchCalibration

FIRST_IMAGE_S = 5.0  # longest wait for the camera
ENGAGE_S = 15.0  # longest wait for the board to follow once it is asked
MAX_S = 3600.0  # of --seconds
DEAF_S = 1.0  # without a press before Enter counts, from the start and after a take-over
TAKEN_OVER = "the person took over with a stick"
YOU_FLY = "You fly. Enter: ask the board to follow; then hold the trainer switch"
LET_GO = "LET GO OF THE TRAINER SWITCH: the board sends idle and neutral"
ENDINGS = ("duration", "interrupted", TAKEN_OVER)  # of a flight that went as it should


def fly_aircraft(fly: "Fly") -> int:
    """Fly as the options say, until the time is up, Ctrl-C, the person or the supervisor.

    Returns:
        0 if the aircraft was flown and nobody but the person or the clock ended it, else 1.

    Raises:
        InputError: an option is wrong, a step before the flight is missing (the message names it),
            or camera or board cannot be used.
    """
    from falconwing_kit.tools.cli.scene_input import parse_place

    bench = _check(fly)
    fly = fly if fly.camera_at else replace(fly, camera_at=builder_place())
    p_body_camera = parse_place("--camera-at", fly.camera_at)
    pilot, lens = _load_pilot(fly)
    with ExitStack() as stack:
        port = stack.enter_context(open_ready_port(fly.port, fly.calibration, fly.radio))
        images = _open_images(stack, fly, bench)
        is_straight = bench is not None and bench.lens is not None
        log = _open_log(stack, fly, port, lens, is_straight, p_body_camera)
        enter = EnterKey() if fly.hand_over == "enter" else None
        sink = AircraftPort(port, log, enter, pilot.reset)
        supervisor = HandOverSupervisor(_limits(fly, bench), sink)
        loop = Loop(
            pilot, sink, images, clock=WallClock(), log=log, supervisor=supervisor,
            hooks=(_StatusHook(port),),
        )  # fmt: skip
        try:
            flight = loop.run(fly.seconds, sink.stop_reason)
        finally:  # at once: a camera or a disk may take seconds to close
            sink.hand_back()
        record = _record(fly, port, sink, supervisor, flight)
    _show(fly, record)
    return 0 if sink.engaged_at is not None and flight.reason in ENDINGS else 1


def builder_place() -> str:
    """Place of the camera on the aircraft to build, as --camera-at gives it: the simulator's is in
    the tip of the spinner, where no real camera can be.
    """
    from falconwing_kit.aircraft.airframe import builder_airframe_path, load_airframe

    return ",".join(f"{x:g}" for x in load_airframe(builder_airframe_path()).p_body_camera)


class EnterKey:
    """The lines that the operator types on standard input, read without waiting for them."""

    def __init__(self) -> None:
        self.has_ended = sys.stdin is None  # True: nobody can press Enter any more
        self._pressed = threading.Event()
        if not self.has_ended:
            threading.Thread(target=self._read, args=(sys.stdin,), daemon=True).start()

    def take(self) -> bool:
        """Whether Enter was pressed since the last call."""
        was_pressed = self._pressed.is_set()
        self._pressed.clear()
        return was_pressed

    def _read(self, lines: Any) -> None:
        with suppress(OSError, ValueError):  # a closed terminal, a key that is no text
            for _ in lines:
                self._pressed.set()
        self.has_ended = True


class AircraftPort:
    """Sink of the loop: commands -> trainer port, which is engaged without a jump of the sticks.

    Until the board follows, it gets the person's own sticks, as its pilot input measures them, or
    idle and neutral where it measures none; from then on the pilot's commands, and after a
    hand-back idle and neutral. With an Enter key the board is asked to follow when that is pressed,
    as often as the person takes over with a stick; without one it is asked at once, once.

    Args:
        port: ready.
        log: for the port's events; None for none.
        enter: asks; None asks at once.
        reset: of the pilot, with which every hand-over begins: what it remembers of the person's
            part, as a landing, is not of its own flight.
    """

    def __init__(
        self, port: TrainerPort, log: "FlightLogWriter | None" = None,
        enter: EnterKey | None = None, reset: Callable[[], object] = lambda: None,
    ) -> None:  # fmt: skip
        self.port, self._log, self._enter, self._reset = port, log, enter, reset
        self.engaged_at: float | None = None  # time of the loop at which it followed first [s]
        self.engagements = 0
        self.trouble = ""  # for which the board is not asked now; set by the supervisor
        self._is_asked = enter is None  # False: the person flies, and the board is not to follow
        self._asked_at, self._deaf_until = 0.0, DEAF_S  # [s]
        self._had_sticks = False  # they were measured in this flight
        self._is_over = False  # control was handed back
        self._dropped: Mapping[str, Any] = {}  # the event that ended the engagement
        if enter is not None:
            _say(YOU_FLY)

    @property
    def is_judged(self) -> bool:
        """Whether a fault ends the flight: with Enter, only while the board follows."""
        return self._enter is None or self.port.engagement == "engaged"

    def send(self, t: float, command: Command) -> Command | None:
        """Send the command at t [s], or the person's sticks while the board does not follow yet.

        Returns:
            The sticks where they are measured and fly in place of the command, for these are the
            past commands that the pilot is told of; else None.
        """
        self.port.poll()
        self._read_events(t)
        measured = pilot_sticks(self.port)
        self._had_sticks = self._had_sticks or bool(measured)
        if self._enter is not None and not self._is_over:
            self._read_key(t, self._enter.take(), bool(measured))
        sticks: Command | None = None
        if self._is_over or (self.port.engagement == "dropped" and self._is_asked):
            command = SAFE_COMMAND
        elif self.port.engagement != "engaged":
            if measured:
                throttle, aileron, elevator, rudder = measured
                sticks = Command.clip(throttle, aileron, elevator, rudder)
            command = sticks or SAFE_COMMAND
        self.port.send(command, engage=self._is_asked)
        return sticks

    def hand_back(self) -> None:
        """Return control to the person; later commands are not followed."""
        if self.port.engagement in ("engaged", "dropped") and not self._is_over:
            alert(LET_GO)
        self._is_over = True
        self.port.hand_back()

    def stop_reason(self, step: LoopStep) -> str:
        """Why the flight is over; empty to go on."""
        if self.port.engagement == "dropped" and self._is_asked:
            return TAKEN_OVER if self._is_taken_over else f"the board dropped: {self._dropped}"
        if self.port.state in ("silent", "lost"):
            return f"port {self.port.state}"
        if self._enter is None:
            late = self.engaged_at is None and step.t > ENGAGE_S
            return f"the board did not engage within {ENGAGE_S:g} s" if late else ""
        if self._enter.has_ended and not self._is_asked:
            return "standard input has ended, so nobody can press Enter; run it at a terminal"
        return ""

    @property
    def _is_taken_over(self) -> bool:
        """Whether a stick ended the engagement."""
        return self.port.engagement == "dropped" and self._dropped.get("event") == "pilot took over"

    def _read_key(self, t: float, was_pressed: bool, has_sticks: bool) -> None:
        """Ask the board to follow when Enter is pressed; stop asking when the person took over."""
        if self._is_asked:
            if self._is_taken_over:
                self._stop_asking(t, f"Taken over. {LET_GO}.")
            elif self.port.engagement in ("asking", "engaging"):
                late = t - self._asked_at > ENGAGE_S
                why = self.trouble or (late and (self.port.mismatch() or f"{ENGAGE_S:g} s passed"))
                if why:
                    self._stop_asking(t, f"The board does not follow: {why}.")
        elif was_pressed and t < self._deaf_until:  # typed before the flight, or a key that is held
            self._deaf_until = t + DEAF_S
        elif was_pressed:
            why = self.trouble
            if self._had_sticks and not has_sticks:
                why = why or "the sticks are measured no more, so no stick would take over"
            if why:
                self._write_event(t, "not asked", {"why": why})
                _say(f"Not asked: {why}")
            else:
                self._is_asked, self._asked_at, self._dropped = True, t, {}
                self._reset()
                self._write_event(t, "asked to follow", {})

    def _stop_asking(self, t: float, why: str) -> None:
        self._is_asked, self._deaf_until = False, t + DEAF_S
        self._write_event(t, "not asked", {"why": why})
        _say(f"{why} {YOU_FLY}")

    def _read_events(self, t: float) -> None:
        """Note and log what happened at the port."""
        while self.port.events:
            event = self.port.events.popleft()
            if event.name == "engaged":
                self.engaged_at = t if self.engaged_at is None else self.engaged_at
                self.engagements += 1
                _say("\aENGAGED: the pilot's commands go out")
            if event.name in ("dropped", "pilot took over", "no pulses", "bad command"):
                self._dropped = {"event": event.name, **event.details}
            self._write_event(t, event.name, event.details)

    def _write_event(self, t: float, name: str, details: Mapping[str, Any]) -> None:
        if self._log is not None:
            try:
                self._log.event(t, name, details)
            except InputError:  # a full disk; the loop, which writes here too, reports it
                self._log = None


class HandOverSupervisor(Supervisor):
    """A supervisor whose reason ends a flight only while the board follows.

    What it finds while the person flies is forgotten there; as long as it is found, the board is
    not asked to follow. With `--hand-over now` it judges from the first step on.

    Args:
        settings: limits.
        sink: says who flies.
    """

    def __init__(self, settings: SupervisorSettings, sink: AircraftPort) -> None:
        super().__init__(settings, by_images=True, monitor=FrameMonitor())
        self._sink, self._is_empty = sink, False

    def check(
        self, t: float, command: Command | None, state: State | None = None, pilot_s: float = 0.0
    ) -> str:
        """Judge a command before it is sent; empty while the person flies."""
        largest_age_s = self.largest_age_s
        reason = super().check(t, command, state, pilot_s)
        if self._sink.is_judged:
            return reason
        if reason.startswith("battery") and not self._is_empty:
            self._is_empty = True
            alert(f"{reason}: land")
        self._sink.trouble = reason
        self.reason, self.largest_age_s = "", largest_age_s
        return ""


def _say(sentence: str) -> None:
    """Print a sentence on a line of its own, below the status line."""
    print(f"\n{sentence}", file=sys.stderr, flush=True)


@dataclass
class _StatusHook:
    """The status line, as a hook of the loop."""

    port: TrainerPort

    def __post_init__(self) -> None:
        self._line = StatusLine(self.port, 0.0, moves=False)

    def __call__(self, step: LoopStep) -> None:
        self._line.is_over()


def _check(fly: "Fly") -> "BenchCalibration | None":
    """Refuse wrong options and missing steps before anything is opened; the bench's file."""
    if not fly.port or fly.source != "camera":
        raise InputError(
            f"--port {fly.port or 'none'}, --source {fly.source}: expected a serial port and"
            " --source camera together for a real aircraft, or a simulated board (sim, sim-python)"
            " and --source sim"
        )
    defaults = type(fly)()
    for name in ("trials", "workers", "cluster", "start", "against", "no_render"):
        if getattr(fly, name) != getattr(defaults, name):
            option = name.replace("_", "-")
            raise InputError(
                f"--{option}: expected it in simulation only, got --source camera; leave it out"
            )
    require_range("--seconds", fly.seconds, low=1.0, high=MAX_S)
    if PILOTS[fly.pilot].reads_state:
        by_images = ", ".join(name for name, each in PILOTS.items() if not each.reads_state)
        raise InputError(
            f"--pilot {fly.pilot}: expected a pilot by images for a real aircraft ({by_images}),"
            " got one by the state, which no camera measures"
        )
    is_real = fly.port not in SIMULATED_PORTS
    if is_real:
        from falconwing_kit.tools.hardware.bench_record import require_bench_test
        from falconwing_kit.tools.hardware.checklists import load_checklists

        calibration = choose_calibration(fly.port, fly.calibration, fly.radio)
        path = require_bench_test(fly.checklists, load_checklists().bench, calibration)
        print(f"bench test of {calibration.radio}: {path}", file=sys.stderr)
    if fly.bench is None:
        print(
            "warning: no --bench FILE: the lens is assumed to be the kit's, without distortion;"
            " measure yours with falconwing bench",
            file=sys.stderr,
        )
        return None
    from falconwing_kit.tools.devices.calibration import read_bench

    return read_bench(fly.bench, for_aircraft=is_real)


def _load_pilot(fly: "Fly") -> tuple[Any, "PinholeCamera"]:
    """The pilot, for the camera's own image size; loaded before the camera runs."""
    from falconwing_kit.tools.cli.fly import make_pilot
    from falconwing_kit.tools.devices.cameras import open_camera

    camera = open_camera(fly.camera)
    try:
        camera.open()
        pixels = camera.read()
    except (OSError, EOFError) as error:
        raise InputError(f"--camera {fly.camera}: {error}") from None
    finally:
        camera.close()
    if pixels is None:
        raise InputError(f"--camera {fly.camera}: expected an image, got none; is it plugged in?")
    height, width = pixels.shape[:2]
    sized = replace(fly, size=f"{width}x{height}")
    task = sized._task()
    return make_pilot(sized, task, sized._model(task))(task.trial(0)), sized._setting().camera


def _open_images(stack: ExitStack, fly: "Fly", bench: "BenchCalibration | None") -> "ImageSource":
    """The camera's images, undistorted if the lens is known; the first one is there."""
    from falconwing_kit.tools.devices.calibration import StraightImages
    from falconwing_kit.tools.devices.cameras import open_camera
    from falconwing_kit.tools.devices.grabber import Grabber

    images = stack.enter_context(Grabber(open_camera(fly.camera)))
    if not images.wait(1, FIRST_IMAGE_S):
        raise InputError(
            f"--camera {fly.camera}: expected an image, got none; {images.health.trouble}"
        )
    return (
        images if bench is None or bench.lens is None else StraightImages(images, bench.lens.lens)
    )


def _limits(fly: "Fly", bench: "BenchCalibration | None") -> SupervisorSettings:
    """The supervisor's; the measured delay of the camera counts towards the age of an image."""
    max_age_s = fly.max_image_age
    if bench is not None and bench.latency is not None:
        max_age_s -= bench.latency.camera_s
    return SupervisorSettings(max_image_age_s=max_age_s, battery_s=fly.battery_s)


def _open_log(
    stack: ExitStack,
    fly: "Fly",
    port: TrainerPort,
    lens: "PinholeCamera",
    is_straight: bool,
    p_body_camera: tuple[float, float, float],
) -> "FlightLogWriter | None":
    """The flight log in --out."""
    if fly.out is None:
        print("warning: no --out DIR: this flight is not logged", file=sys.stderr)
        return None
    from falconwing_kit.core.flight_log import FlightLogWriter
    from falconwing_kit.tools.bridge.recording import recording_metadata

    fly.out.mkdir(parents=True, exist_ok=True)
    path = fly.out / time.strftime("flight_%Y%m%d_%H%M%S.mcap")
    log = stack.enter_context(FlightLogWriter(path))
    how = recording_metadata(port, lens, undistorted=is_straight)
    place = {"p_body_camera": json.dumps(p_body_camera)}
    log.metadata({**how, "mode": "autonomous", "pilot": fly.pilot, "task": fly.task, **place})
    return log


def _record(
    fly: "Fly", port: TrainerPort, sink: AircraftPort, supervisor: Supervisor, flight: LoopResult
) -> dict[str, Any]:
    """What the flight was."""
    return {
        "board": port.what,
        "simulated_board": port.simulation is not None,
        "task": fly.task,
        "pilot": fly.pilot,
        "camera_at_m": fly.camera_at,
        "reason": supervisor.reason or flight.reason,
        "engaged_at_s": sink.engaged_at,
        "engagements": sink.engagements,
        "seconds": round(float(flight.t[-1]), 2) if len(flight.t) else 0.0,
        "steps": len(flight.t),
        "skipped": flight.skipped,
        "largest_image_age_s": round(supervisor.largest_age_s, 3),
        "margin_s": round(supervisor.margin_s, 3),
        **{f"commands_{name}": asdict(port.counters)[name] for name in ("sent", "dropped")},
    }


def _show(fly: "Fly", record: dict[str, Any]) -> None:
    if fly.json:
        print_json(record)
        return
    title = "SIMULATED board, no aircraft" if record["simulated_board"] else "flight"
    print_table(("what", "value"), list(record.items()), title=title)
    if fly.out is None:
        next_line("the same with --out flights, which keeps a log")
    else:
        next_line(f"falconwing replay {fly.out}/flight_*.mcap")
