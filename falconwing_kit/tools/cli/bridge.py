"""falconwing bridge, record and find-port: the board on a serial port, watched, recorded from, and
found.
"""

import math
import shutil
import sys
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from falconwing_kit.core.checks import InputError, require_range
from falconwing_kit.core.messages import COMMAND_NAMES, Command
from falconwing_kit.tools.bridge.open_port import open_port
from falconwing_kit.tools.cli.calibrate import SIMULATED_PORTS, choose_calibration
from falconwing_kit.tools.cli.show import next_line, print_json, print_table
from falconwing_kit.trainer_port.port import TrainerPort

if TYPE_CHECKING:
    from falconwing_kit.core.flight_log import FlightLogWriter
    from falconwing_kit.flight.loop import ImageSource
    from falconwing_kit.tools.bridge.recording import Recording

LOOK_S = 0.005  # between two looks at the port
PERIOD_S = 0.05  # between two commands of --move-sticks
SHOW_S = 0.25  # between two live lines
PILOT_SILENT = 0.5  # s without a frame of the pilot's radio, of which 45 come in a second
LONGEST_S = 1e5  # a day and more; 0 is for ever


@dataclass(frozen=True)
class Bridge:
    """Show what the board says: state, counters, delay, the pilot's sticks. Sends commands only
    where asked.

    Ctrl-C ends it, and hands the sticks back. Exit code 0 where the board answered to the end, else
    1.
    """

    port: str
    """serial port of the trainer bridge; sim is the firmware in a simulated chip, sim-python a
    plain board
    """
    seconds: float = 0.0
    """how long; 0 is until Ctrl-C"""
    calibration: Path | None = None
    """file of falconwing calibrate; without it ./trainer_port.toml, or the kit's default"""
    radio: str = ""
    """refuse a calibration of another radio"""
    ros: bool = False
    """carry commands from ROS to the board, and its status and pilot to ROS"""
    move_sticks: bool = False
    """engage, and move aileron, elevator and rudder slowly with the throttle idle: for the bench,
    propeller off
    """
    json: bool = False
    """print JSON instead of a table"""

    def run(self) -> int:
        """Watch until time is up or Ctrl-C.

        Returns:
            0 where the board answered to the end, else 1.

        Raises:
            InputError: the port cannot be opened, no board answers, or the calibration does not
                fit.
        """
        require_range("--seconds", self.seconds, low=0.0, high=LONGEST_S)
        if self.ros and self.move_sticks:
            raise InputError(
                "--move-sticks: expected it or --ros, for one of them gives the commands; leave one out"
            )
        with open_ready_port(self.port, self.calibration, self.radio) as port:
            live = StatusLine(port, self.seconds)
            with suppress(KeyboardInterrupt):
                if self.ros:
                    self._relay(port, live)
                else:
                    self._watch(port, live)
            live.end()
            answered, record = port.state == "open", port_record(port)
        if self.json:
            print_json(record)
        else:
            flat = [
                (name, ", ".join(map(str, v)) if isinstance(v, list) else v)
                for name, v in record.items()
            ]
            print_table(
                ("what", "value"), [(name.replace("_", " "), value) for name, value in flat]
            )
            next_line(f"falconwing record --port {self.port} --out recordings")
        return 0 if answered else 1

    def _watch(self, port: TrainerPort, live: "StatusLine") -> None:
        """Look, and at 20 Hz send what moves the sticks where that is wanted."""
        began, sent = time.perf_counter(), 0
        while not live.over():
            t = time.perf_counter() - began
            if self.move_sticks and t >= PERIOD_S * sent:
                aileron, elevator, rudder = (
                    0.3 * math.sin(2.0 * math.pi * f * t) for f in (0.2, 0.3, 0.5)
                )
                port.send(Command(0.0, aileron, elevator, rudder), engage=True)
                sent = int(t / PERIOD_S) + 1
            port.poll()
            time.sleep(LOOK_S)

    def _relay(self, port: TrainerPort, live: "StatusLine") -> None:
        from falconwing_kit.tools.bridge.bus import relay
        from falconwing_kit.tools.bridge.ros import RosBus

        bus = RosBus()
        try:
            relay(port, bus, live.over)
        finally:
            bus.close()


@dataclass(frozen=True)
class Record:
    """Record the pilot's sticks and the camera's images while the pilot flies by hand, for
    identification.

    The frame monitor judges every picture; its alarms are said at once and are events of the log.

    Ctrl-C ends the recording; a log that was cut short is made whole by falconwing export --to
    mcap.
    """

    port: str
    """serial port of the trainer bridge, or sim"""
    source: Literal["camera", "sim"] = "camera"
    """where images come from; sim is a SIMULATED approach by hand, with --port sim"""
    camera: str = "0"
    """number or path of the camera, or a video file"""
    out: Path = Path("recordings")
    """folder for the log, whose name is the time"""
    seconds: float = 0.0
    """how long; 0 is until Ctrl-C, or until a simulated approach is over"""
    calibration: Path | None = None
    """file of falconwing calibrate; without it ./trainer_port.toml, or the kit's default"""
    radio: str = ""
    """refuse a calibration of another radio"""
    json: bool = False
    """print JSON instead of a table"""

    def run(self) -> int:
        """Record until time is up or Ctrl-C.

        Returns:
            0 where sticks were recorded to the end, 1 where none came or the disk was full.

        Raises:
            InputError: the port or the camera cannot be used, the log cannot be written, or an
                option is wrong.
        """
        require_range("--seconds", self.seconds, low=0.0, high=LONGEST_S)
        if self.source == "sim" and self.port not in SIMULATED_PORTS:
            raise InputError(
                f"--source sim: expected a simulated board with it, got --port {self.port}; add --port sim"
            )
        if self.out.exists() and not self.out.is_dir():
            raise InputError(
                f"--out {self.out}: expected a folder, got a file; choose another name"
            )
        self.out.mkdir(parents=True, exist_ok=True)
        path = self.out / time.strftime("record_%Y%m%d_%H%M%S.mcap")
        with ExitStack() as stack:
            port = stack.enter_context(open_ready_port(self.port, self.calibration, self.radio))
            images = self._images(stack, port)
            recording = self._record(port, images, path)
        return self._show(path, recording)

    def _images(self, stack: ExitStack, port: TrainerPort) -> "ImageSource":
        """The camera, or the view of a simulated approach."""
        if self.source == "sim" and port.simulation is not None:
            from falconwing_kit.scene.arena import load_scene
            from falconwing_kit.tools.bridge.rehearsal import SimulatedManualApproach

            return SimulatedManualApproach(port.simulation, port.calibration, load_scene("arena"))
        from falconwing_kit.tools.devices.cameras import open_camera
        from falconwing_kit.tools.devices.grabber import Grabber

        return stack.enter_context(Grabber(open_camera(self.camera)))

    def _record(self, port: TrainerPort, images: "ImageSource", path: Path) -> "Recording":
        """The recording itself; a disk that is full has raised its alert already."""
        from falconwing_kit.core.flight_log import FlightLogWriter
        from falconwing_kit.tools.bridge.recording import Recording

        recording: Recording | None = None
        try:
            with FlightLogWriter(path) as log:
                recording = self._run(port, images, log)
        except InputError:
            if recording is None or not recording.stopped:
                raise
        return recording

    def _run(self, port: TrainerPort, images: "ImageSource", log: "FlightLogWriter") -> "Recording":
        from falconwing_kit.tools.bridge.recording import Recording, record
        from falconwing_kit.vision.monitor import FrameMonitor

        live = StatusLine(port, self.seconds, moves=self.source == "camera")
        recording = Recording(port, log, images, live.alert, FrameMonitor())
        with suppress(KeyboardInterrupt):
            record(recording, watch=lambda now: live.over(now) or getattr(images, "over", False))
        live.end()
        return recording

    def _show(self, path: Path, recording: "Recording") -> int:
        complete = not recording.stopped and recording.counts.commands > 0
        record = {"file": str(path), **asdict(recording.counts), "seconds": round(recording.t, 2)}
        record |= {"stopped": recording.stopped, "board": recording.port.what}
        if self.json:
            print_json(record)
            return 0 if complete else 1
        print_table(("what", "value"), list(record.items()))
        if recording.counts.images == 0:
            print(f"no image came: is the camera plugged in, and is it {self.camera} (--camera)?")
        if recording.stopped:
            next_line(f"make room, then falconwing export {path} --to mcap --out saved.mcap")
        elif recording.counts.commands == 0:
            next_line(
                "no sticks came: is the radio on and its cable in? falconwing bridge shows the pilot's sticks"
            )
        else:
            next_line(f"falconwing export {path} --out flight.csv")
        return 0 if complete else 1


@dataclass(frozen=True)
class FindPort:
    """List boards on USB and say which looks like the Mega 2560, and how to get the right to open
    it.

    Exit code 0 where one may be it, else 1. None is opened, for that could restart a board.
    """

    json: bool = False
    """print JSON instead of a table"""

    def run(self) -> int:
        """Look.

        Returns:
            0 where a board may be the Mega, else 1.
        """
        from falconwing_kit.trainer_port.usb import find_boards

        boards = find_boards()
        likely = [board for board in boards if board.likely]
        if self.json:
            print_json({"boards": [asdict(board) for board in boards]})
        elif not boards:
            print("no board on a USB serial port found")
            next_line(
                "plug the Mega in with a cable that carries data; without one, --port sim is a simulated board"
            )
        else:
            rows = [
                (board.path, board.what, board.likely, board.may_open, board.mend)
                for board in boards
            ]
            print_table(("port", "what", "may be it", "may be opened", "to mend"), rows)
            usable = next((board.path for board in likely if board.may_open), None)
            next_line(
                f"falconwing bridge --port {usable}"
                if usable
                else "mend what the table says, then look again"
            )
        return 0 if likely else 1


@dataclass
class StatusLine:
    """One line on the terminal that says how the board does, written over again; nothing where
    nobody looks on.
    """

    port: TrainerPort
    seconds: float  # until `over`; 0 is for ever
    moves: bool = (
        True  # the sticks of a simulated board's pilot are moved, so that there is something to see
    )
    _began: float = field(default_factory=time.perf_counter)
    _shown: float = -math.inf

    def over(self, recording: "Recording | None" = None) -> bool:
        """Show the line where it is time; True when time is up."""
        t = time.perf_counter() - self._began
        if t - self._shown >= SHOW_S:
            self._shown = t
            if self.moves:
                move_sticks(self.port, t)
            if sys.stderr.isatty():
                counts = (
                    ""
                    if recording is None
                    else f"  log {recording.counts.commands}/{recording.counts.images}"
                )
                text = status_text(self.port) + counts
                room = (
                    shutil.get_terminal_size().columns - 1
                )  # a line that wraps cannot be written over
                print(f"\r{text[:room]}\x1b[K", end="", file=sys.stderr, flush=True)
        return 0.0 < self.seconds <= t

    def alert(self, sentence: str) -> None:
        """Say at once what must not be missed."""
        print(f"\n\aALERT: {sentence}", file=sys.stderr, flush=True)

    def end(self) -> None:
        """Leave the line."""
        if sys.stderr.isatty():
            print(file=sys.stderr)


@contextmanager
def open_ready_port(name: str, calibration: Path | None, radio: str = "") -> Iterator[TrainerPort]:
    """An open port whose board answers; left in whatever way, the sticks are handed back.

    Args:
        name: of the port.
        calibration: its file; None takes what `choose_calibration` finds.
        radio: must be the one it was measured on; "" does not ask.

    Raises:
        InputError: the port cannot be opened, no board answers, or the calibration is stale or does
            not fit.
    """
    with open_port(name, choose_calibration(name, calibration, radio)) as port:
        wait = "" if port.simulation else "; where it restarts, it answers in two seconds"
        print(f"{port.what}{wait}", file=sys.stderr, flush=True)
        port.wait_ready()
        yield port


def status_text(port: TrainerPort) -> str:
    """How the board does, in one line."""
    status, counters = port.status, port.counters
    if status is None or port.state != "open":
        return f"port {port.state}"
    sticks = " ".join(f"{position:+.2f}" for position in pilot_sticks(port)) or "none"
    slots = " ".join(map(str, status.channels_us))
    return (
        f"{status.state}{'' if status.fault == 'none' else ' ' + status.fault}  {slots} us  pilot {sticks}  "
        f"boots {status.boot_count}  frames {status.ppm_frames}  round trip {1e3 * port.clock.round_trip:.1f} ms  "
        f"sent {counters.sent} dropped {counters.dropped} bad {counters.bad + status.bad_frames}"
    )


def pilot_sticks(port: TrainerPort) -> list[float]:
    """Throttle, aileron, elevator and rudder as the pilot holds them; empty where they are not
    known, or no longer.
    """
    if (
        port.pilot is None
        or port.now() - port.to_host_time(port.pilot.device_time_us) > PILOT_SILENT
    ):
        return []
    with suppress(InputError):
        return [
            round(position, 3)
            for position in port.calibration.command(port.pilot.channels_us).vector.tolist()
        ]
    return []


def port_record(port: TrainerPort) -> dict[str, Any]:
    """What there is to know about a port, in the words of the table."""
    status = port.status
    record: dict[str, Any] = {"board": port.what, "port": port.state, "engagement": port.engagement}
    record |= {
        **asdict(port.counters),
        "engaged": sum(event.name == "engaged" for event in port.events),
    }
    if status is None:
        return record
    record |= {"state": status.state, "fault": status.fault, "boot_count": status.boot_count}
    record |= {"reset_causes": list(status.reset_causes), "channels_us": list(status.channels_us)}
    for name in ("bad_frames", "bad_sequence", "out_of_range", "ppm_frames"):
        record[f"board_{name}"] = getattr(status, name)
    record["status_age_ms"] = 1e3 * port.status_age
    record["round_trip_ms"] = 1e3 * port.clock.round_trip
    record["clock_error_ms"] = 1e3 * port.clock.error_bound(status.device_time_us)
    record["clock_drift_ppm"] = port.clock.drift_ppm
    record |= dict(
        zip((f"pilot_{name}" for name in COMMAND_NAMES), pilot_sticks(port), strict=False)
    )
    return record | ({} if port.pilot is None else {"pilot_frames_rejected": port.pilot.rejected})


def move_sticks(port: TrainerPort, t: float) -> None:
    """The pilot of a SIMULATED board circles its sticks; a real one moves its own."""
    if port.simulation is None:
        return
    side, up = 0.8 * math.sin(t), 0.8 * math.cos(t)
    with port.simulation.pause() as board:
        board.set_pilot(port.calibration.channels_us(Command(0.5 + 0.5 * up, side, up, -side)))
