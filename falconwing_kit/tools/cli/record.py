"""falconwing record: log a manual flight: the pilot's sticks and the camera's images."""

import sys
import time
from collections.abc import Callable
from contextlib import ExitStack, suppress
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Literal

from falconwing_kit.core.checks import InputError, require_range
from falconwing_kit.core.flight_log import FlightLogWriter
from falconwing_kit.flight.loop import ImageSource, PacedClock
from falconwing_kit.tools.bridge.open_port import open_paced_port
from falconwing_kit.tools.bridge.recording import Recording, record
from falconwing_kit.tools.bridge.rehearsal import SimulatedManualApproach
from falconwing_kit.tools.cli.board_status import MAX_S, StatusLine, alert, open_ready_port
from falconwing_kit.tools.cli.calibrate import SIMULATED_PORTS, choose_calibration
from falconwing_kit.tools.cli.show import next_line, print_json, print_table
from falconwing_kit.tools.devices.calibration import StraightImages, read_bench
from falconwing_kit.tools.devices.cameras import open_camera
from falconwing_kit.tools.devices.grabber import Grabber
from falconwing_kit.tools.devices.lens import Lens
from falconwing_kit.trainer_port.port import TrainerPort
from falconwing_kit.vision.monitor import FrameMonitor


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
    bench: Path | None = None
    """file of falconwing bench: the images are undistorted before they are logged"""
    calibration: Path | None = None
    """file of falconwing calibrate; without it ./trainer_port.toml, or the kit's default"""
    radio: str = ""
    """refuse a calibration of another radio"""
    json: bool = False
    """print JSON instead of a table"""

    def run(self) -> int:
        """Record until the time is up or Ctrl-C.

        Returns:
            0 if sticks and images were recorded until the end, 1 if none came or the disk was full.

        Raises:
            InputError: the port or the camera cannot be used, the log cannot be written, or an
                option is wrong.
        """
        require_range("--seconds", self.seconds, low=0.0, high=MAX_S)
        if self.source == "sim" and self.port not in SIMULATED_PORTS:
            raise InputError(
                f"--source sim: expected a simulated board, got --port {self.port}; use --port sim"
            )
        if self.source == "sim" and self.bench is not None:
            raise InputError("--bench: expected it with a real camera, got --source sim")
        is_real = self.port not in SIMULATED_PORTS
        lens = None if self.bench is None else read_bench(self.bench, is_real).require_lens()
        if self.out.exists() and not self.out.is_dir():
            raise InputError(
                f"--out {self.out}: expected a folder, got a file; choose another name"
            )
        self.out.mkdir(parents=True, exist_ok=True)
        path = self.out / time.strftime("record_%Y%m%d_%H%M%S.mcap")
        with ExitStack() as stack:
            if self.source == "sim":
                calibration = choose_calibration(self.port, self.calibration, self.radio)
                clock = PacedClock()
                clock.start()
                port = stack.enter_context(open_paced_port(self.port, clock, calibration))
                print(port.what, file=sys.stderr, flush=True)
                recording = self._record(
                    port, _approach(port), path, pause=lambda s: clock.wait_until(clock.now() + s)
                )
            else:
                port = stack.enter_context(open_ready_port(self.port, self.calibration, self.radio))
                camera = stack.enter_context(Grabber(open_camera(self.camera)))
                images = camera if lens is None else StraightImages(camera, lens)
                recording = self._record(port, images, path, lens)
        return self._show(path, recording)

    def _record(
        self,
        port: TrainerPort,
        images: ImageSource,
        path: Path,
        lens: Lens | None = None,
        pause: Callable[[float], Any] = time.sleep,
    ) -> Recording:
        """Write the log; a full disk has already raised an alert and ends the recording."""
        recording: Recording | None = None
        try:
            with FlightLogWriter(path) as log:
                recording = Recording(
                    port, log, images, alert, FrameMonitor(),
                    None if lens is None else lens.camera(),
                )  # fmt: skip
                self._run(recording, pause)
        except InputError:
            if recording is None or not recording.stopped:
                raise
        return recording

    def _run(self, recording: Recording, pause: Callable[[float], Any]) -> None:
        line = StatusLine(recording.port, self.seconds, moves=self.source == "camera")
        with suppress(KeyboardInterrupt):
            record(
                recording,
                watch=lambda now: line.is_over(now) or getattr(recording.images, "over", False),
                pause=pause,
            )
        line.end()

    def _show(self, path: Path, recording: Recording) -> int:
        """Print what was recorded; the exit code."""
        counts = recording.counts
        complete = not recording.stopped and counts.commands > 0 and counts.images > 0
        facts = {"file": str(path), **asdict(recording.counts), "seconds": round(recording.t, 2)}
        facts |= {"stopped": recording.stopped, "board": recording.port.what}
        if counts.images == 0:
            print(
                f"no image came: is the camera plugged in, and is it {self.camera} (--camera)?",
                file=sys.stderr,
            )
        if self.json:
            print_json(facts)
            return 0 if complete else 1
        print_table(("what", "value"), list(facts.items()))
        if recording.stopped:
            next_line(f"free disk space, then falconwing export {path} --to mcap --out saved.mcap")
        elif counts.commands == 0:
            next_line(
                "no sticks came: is the radio on and its cable in? "
                "falconwing bridge shows the pilot's sticks"
            )
        else:
            next_line(f"falconwing export {path} --out flight.csv")
        return 0 if complete else 1


def _approach(port: TrainerPort) -> SimulatedManualApproach:
    """The view of a SIMULATED approach, whose pilot moves the sticks of the board's radio."""
    from falconwing_kit.scene.arena import load_scene

    return SimulatedManualApproach(port.simulation, port.calibration, load_scene("arena"))
