"""falconwing record: log a manual flight: the pilot's sticks and the camera's images."""

import time
from contextlib import ExitStack, suppress
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from falconwing_kit.core.checks import InputError, require_range
from falconwing_kit.tools.cli.board_status import MAX_S, StatusLine, open_ready_port
from falconwing_kit.tools.cli.calibrate import SIMULATED_PORTS
from falconwing_kit.tools.cli.show import next_line, print_json, print_table
from falconwing_kit.trainer_port.port import TrainerPort

if TYPE_CHECKING:
    from falconwing_kit.core.flight_log import FlightLogWriter
    from falconwing_kit.flight.loop import ImageSource
    from falconwing_kit.tools.bridge.recording import Recording


@dataclass(frozen=True)
class Record:
    """Record the pilot's sticks and the camera's images during a manual flight, for identification.

    The frame monitor checks every image; its alarms are printed immediately and logged as events.

    Ctrl-C ends the recording. An interrupted log is repaired by falconwing export --to mcap.
    """

    port: str
    """serial port of the trainer bridge, or sim"""
    source: Literal["camera", "sim"] = "camera"
    """source of images; sim is a SIMULATED manual approach, with --port sim"""
    camera: str = "0"
    """number or path of the camera, or a video file"""
    out: Path = Path("recordings")
    """folder for the log, which is named by the time"""
    seconds: float = 0.0
    """duration; 0 is until Ctrl-C, or until a simulated approach ends"""
    calibration: Path | None = None
    """file of falconwing calibrate; without it ./trainer_port.toml, or the kit's default"""
    radio: str = ""
    """refuse a calibration of another radio"""
    json: bool = False
    """print JSON instead of a table"""

    def run(self) -> int:
        """Record until the time is up or Ctrl-C.

        Returns:
            0 if sticks were recorded until the end, 1 if none came or the disk was full.

        Raises:
            InputError: the port or the camera cannot be used, the log cannot be written, or an
                option is wrong.
        """
        require_range("--seconds", self.seconds, low=0.0, high=MAX_S)
        if self.source == "sim" and self.port not in SIMULATED_PORTS:
            raise InputError(
                f"--source sim: expected a simulated board, got --port {self.port}; use --port sim"
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
        """Write the log; a full disk has already raised an alert and ends the recording."""
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

        line = StatusLine(port, self.seconds, moves=self.source == "camera")
        recording = Recording(port, log, images, line.alert, FrameMonitor())
        with suppress(KeyboardInterrupt):
            record(recording, watch=lambda now: line.is_over(now) or getattr(images, "over", False))
        line.end()
        return recording

    def _show(self, path: Path, recording: "Recording") -> int:
        """Print what was recorded; the exit code."""
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
            next_line(f"free disk space, then falconwing export {path} --to mcap --out saved.mcap")
        elif recording.counts.commands == 0:
            next_line(
                "no sticks came: is the radio on and its cable in? "
                "falconwing bridge shows the pilot's sticks"
            )
        else:
            next_line(f"falconwing export {path} --out flight.csv")
        return 0 if complete else 1
