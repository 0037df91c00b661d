"""Recording for identification: pilot frames of the trainer port and camera images -> flight log.

The pilot flies by the radio; nothing here sends a command. Control inputs are logged with the
board's time, converted to the host's clock, and with the newest image taken before them.
"""

import json
import math
import time
from collections import deque
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import asdict, dataclass, replace
from typing import Any

import falconwing_kit
from falconwing_kit.core.checks import InputError
from falconwing_kit.core.flight_log import FlightLogWriter
from falconwing_kit.core.messages import Command, Image
from falconwing_kit.flight.loop import ImageSource
from falconwing_kit.scene.camera import PinholeCamera
from falconwing_kit.trainer_port.port import TrainerPort
from falconwing_kit.trainer_port.protocol import PilotFrame
from falconwing_kit.vision.monitor import FrameMonitor

MAX_IMAGE_WAIT = 0.1  # s that an image waits for the command that is logged before it
PILOT_SILENT = 0.5  # s without a frame of the pilot's radio, which sends 45 per second


@dataclass
class RecordingCounts:
    """Records in the log so far."""

    commands: int = 0
    images: int = 0
    events: int = 0
    alarms: int = 0  # of the frame monitor


class Recording:
    """One recording; call `step`, which never waits, at least 100 times a second.

    If the log cannot be written, for instance on a full disk, recording stops, `stopped` holds the
    reason and `alert` is called with it once. The port is still read: flying must not depend on
    logging.

    Args:
        port: ready; its clock is that of the log, which starts at zero now.
        log: opened and closed by the caller.
        images: the camera, with times of the log; None records control inputs alone.
        alert: called with one sentence when recording stops and when the monitor raises an alarm.
        monitor: checks every image; beginnings and ends of its alarms are events of the log.
        lens: of images that were undistorted; None as the camera gives them.
    """

    def __init__(
        self,
        port: TrainerPort,
        log: FlightLogWriter,
        images: ImageSource | None = None,
        alert: Callable[[str], Any] = lambda sentence: None,
        monitor: FrameMonitor | None = None,
        lens: PinholeCamera | None = None,
    ) -> None:
        self.port, self.log, self.images = port, log, images
        self._alert, self.monitor = alert, monitor
        self.counts, self.stopped = RecordingCounts(), ""
        self.command: Command | None = None  # the newest
        self.image: Image | None = None  # the newest
        self._zero = port.now()
        self._recent: deque[Image] = deque(maxlen=60)  # newest first, to match with commands
        self._unwritten: deque[Image] = deque()  # oldest first
        self._pilot_at, self._silent, self._alarm = 0.0, False, False
        port.pilots.clear()
        flown = getattr(images, "metadata", {})  # of a simulated flight
        self._write(
            lambda log: log.metadata(
                {**flown, **recording_metadata(port, lens, undistorted=lens is not None)}
            )
        )

    @property
    def t(self) -> float:
        """Time of the log [s]."""
        return self.port.now() - self._zero

    def step(self) -> None:
        """Read port and camera and log new data, a command before the image that it refers to."""
        self.port.poll()
        self._check_image(self._read_image())
        while self.port.pilots:
            self._log_pilot_frame(self.port.pilots.popleft())
        while self._unwritten and self.t - self._unwritten[0].t > MAX_IMAGE_WAIT:
            self._write_image(self._unwritten.popleft())
        silent = self.t - self._pilot_at > PILOT_SILENT
        if silent != self._silent:
            self._silent = silent
            self._event(self.t, "pilot silent" if silent else "pilot heard", {})
        while self.port.events:
            event = self.port.events.popleft()
            self._event(max(event.t - self._zero, 0.0), event.name, event.details)

    def finish(self) -> None:
        """Write the waiting images, before the log is closed."""
        self.step()
        while self._unwritten:
            self._write_image(self._unwritten.popleft())

    def _read_image(self) -> Image | None:
        """A new image, or None; after a failure of the camera recording continues without it."""
        if self.images is None:
            return None
        try:
            image = self.images.next_image(self.t)
        except Exception as error:
            self.images = None
            self._event(self.t, "images lost", {"error": f"{type(error).__name__}: {error}"})
            self._alert(f"no more images: {error}")
            return None
        if image is None or (self.image is not None and image.sequence == self.image.sequence):
            return None
        self.image = image
        self._recent.appendleft(image)
        self._unwritten.append(image)
        return image

    def _check_image(self, image: Image | None) -> None:
        """Update the monitor; log and report the beginning of an alarm, and log its end."""
        if self.monitor is None:
            return
        t = self.t
        try:
            verdict = self.monitor.update(image, t)
        except InputError as error:  # an image too small for the monitor
            self.monitor = None
            self._event(t, "monitor off", {"error": str(error)})
            return
        if verdict.alert != self._alarm:
            self._alarm = verdict.alert
            self._event(
                t, "picture alarm" if verdict.alert else "picture clear", {"reason": verdict.reason}
            )
            if verdict.alert:
                self.counts.alarms += 1
                self._alert(f"PICTURE {verdict.reason}")

    def _log_pilot_frame(self, pilot: PilotFrame) -> None:
        """Log the command of one pilot frame, then the images up to the one it refers to."""
        at = self.port.to_host_time(pilot.device_time_us) - self._zero
        t = self._pilot_at = max(at, 0.0) if math.isfinite(at) else self.t
        answered_image = next((image for image in self._recent if image.t <= t), None)
        try:
            command = self.port.calibration.command(pilot.channels_us)
        except InputError as error:  # a radio with fewer channels than the calibration
            self._event(t, "bad pilot frame", {"error": str(error)})
            return
        command = self.command = replace(
            command, image_sequence=-1 if answered_image is None else answered_image.sequence
        )
        if self._write(lambda log: log.command(t, command)):
            self.counts.commands += 1
        while (
            answered_image is not None
            and self._unwritten
            and self._unwritten[0].sequence <= answered_image.sequence
        ):
            self._write_image(self._unwritten.popleft())

    def _write_image(self, image: Image) -> None:
        image = replace(image, t=max(image.t, 0.0))  # a camera runs before the recording does
        if self._write(lambda log: log.image(image)):
            self.counts.images += 1

    def _event(self, t: float, name: str, details: Mapping[str, Any]) -> None:
        if self._write(lambda log: log.event(t, name, details)):
            self.counts.events += 1

    def _write(self, write: Callable[[FlightLogWriter], None]) -> bool:
        """Write to the log; nothing is written after the first error."""
        if self.stopped:
            return False
        try:
            write(self.log)
        except InputError as error:
            self.stopped = f"RECORDING STOPPED after {self.t:.1f} s: {error}"
            self._alert(self.stopped)
            return False
        return True


def record(
    recording: Recording,
    duration: float = math.inf,
    watch: Callable[[Recording], bool | None] = lambda recording: False,
    pause: Callable[[float], Any] = time.sleep,
) -> RecordingCounts:
    """Record until time is up or Ctrl-C.

    Args:
        recording: ready to go.
        duration: maximum [s].
        watch: called after every step; True ends the recording.
        pause: waits [s]; for a simulated clock it advances that.
    """
    with suppress(KeyboardInterrupt):
        while recording.t < duration:
            recording.step()
            if watch(recording):
                break
            pause(0.005)
    recording.finish()
    return recording.counts


def recording_metadata(
    port: TrainerPort, lens: PinholeCamera | None = None, undistorted: bool = False
) -> dict[str, str]:
    """Metadata of the log of a board and a camera.

    Args:
        port: ready.
        lens: of the logged images; None where it is not known.
        undistorted: whether the lens's distortion was removed from them.
    """
    calibration = port.calibration
    optics = {} if lens is None else {"camera": json.dumps(asdict(lens))}
    return {
        **optics,
        "undistorted": "yes" if undistorted else "no",
        "simulated": "yes" if port.simulation is not None else "no",
        "kit_version": falconwing_kit.__version__,
        "port": port.what,
        "mode": "manual: the pilot's sticks as the trainer port gave them",
        "board": port.what,
        "radio": calibration.radio or "not measured: the kit's default calibration",
        "calibrated": calibration.measured or "never",
    }
