"""Cameras: a device, a video file, a simulator or a scripted fake -> frames for the grabber."""

import math
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, Protocol

import numpy as np
from numpy.typing import NDArray

from falconwing_kit.core.checks import InputError, require_file, require_range
from falconwing_kit.core.files import short_name
from falconwing_kit.core.messages import Image
from falconwing_kit.scene.analog import AnalogVideo

CODE_BITS = 16  # of the frame number in a fake camera's image
SPEED_PX = 3.0  # motion of its scene from frame to frame

Pixels = NDArray[np.uint8]
Now = Callable[[], float]
Sleep = Callable[[float], object]


class TimedImageSource(Protocol):
    """Image source of a simulator."""

    def next_image(self, t: float) -> Image | None:
        """The newest image at time t [s]."""


class VideoCamera:
    """A live camera or capture card, by OpenCV.

    Args:
        device: its number from 0, or its path.
        size: (width, height) to request [px]; None for its default.
        rate_hz: frames per second to request; None for its default.
    """

    def __init__(
        self,
        device: int | str = 0,
        size: tuple[int, int] | None = None,
        rate_hz: float | None = None,
    ) -> None:
        self.device, self.size, self.rate_hz = device, size, rate_hz
        self._capture: Any = None

    def open(self) -> None:
        """Open it with a queue of one frame, for current images; OSError if it is missing."""
        import cv2

        self.close()
        self._capture = cv2.VideoCapture(self.device)
        if not self._capture.isOpened():
            self.close()
            raise OSError(
                f"camera {self.device}: expected a camera there, found none; "
                "is it plugged in, is it in use?"
            )
        # Drivers may ignore the queue length; then images are up to four frames old.
        self._capture.set(cv2.CAP_PROP_BUFFERSIZE, 1)
        width, height = self.size or (0, 0)
        for name, value in (
            (cv2.CAP_PROP_FRAME_WIDTH, width),
            (cv2.CAP_PROP_FRAME_HEIGHT, height),
            (cv2.CAP_PROP_FPS, self.rate_hz or 0.0),
        ):
            if value:
                self._capture.set(name, value)

    def read(self) -> Pixels | None:
        """The next frame (H, W, 3) RGB; None if the camera is lost."""
        return _read_rgb(self._capture)

    def close(self) -> None:
        """Release the device."""
        if self._capture is not None:
            self._capture.release()
            self._capture = None


class VideoFile:
    """A recorded video, at its own rate.

    Args:
        path: of the file.
        rate_hz: frames per second; None for the file's own.
        now: the clock [s].
        sleep: waits [s].

    Raises:
        FileNotFoundError: there is no file.
        InputError: it is no video, or contains no frame rate.
    """

    def __init__(
        self,
        path: str | Path,
        rate_hz: float | None = None,
        now: Now = time.perf_counter,
        sleep: Sleep = time.sleep,
    ) -> None:
        self.path = require_file(path)
        self._now, self._sleep = now, sleep
        self.open()
        import cv2

        file_rate_hz = float(self._capture.get(cv2.CAP_PROP_FPS))
        self.close()
        if rate_hz is None and not 0.1 <= file_rate_hz <= 1000.0:
            raise InputError(
                f"{short_name(path)}: expected a video that says its rate, "
                f"got {file_rate_hz:g} frames a second; give rate_hz"
            )
        self.rate_hz = require_range(
            "rate_hz", file_rate_hz if rate_hz is None else rate_hz, low=0.1, high=1000.0
        )

    def open(self) -> None:
        """Rewind to the first frame."""
        import cv2

        self._capture: Any = cv2.VideoCapture(str(self.path))
        self._zero, self._number = self._now(), 0
        if not self._capture.isOpened():
            raise InputError(
                f"{short_name(self.path)}: expected a video, "
                "got a file that OpenCV cannot read as one"
            )

    def read(self) -> Pixels:
        """The next frame (H, W, 3) RGB when it is due; EOFError after the last."""
        pixels = _read_rgb(self._capture)
        if pixels is None:
            raise EOFError(f"{short_name(self.path)}: the video is over")
        _sleep_until(self._zero + self._number / self.rate_hz, self._now, self._sleep)
        self._number += 1
        return pixels

    def close(self) -> None:
        """Close the file."""
        self._capture.release()


class SimulatedCamera:
    """A simulator's images at a camera's own rate, independent of the control loop.

    Args:
        source: image source of the simulator; called, and thus advanced, in the grabber's thread.
        rate_hz: frames per second.
        now: the clock [s].
        sleep: waits [s].

    Raises:
        InputError: the rate is not a number from 0.1 to 1000.
    """

    def __init__(
        self,
        source: TimedImageSource,
        rate_hz: float = 20.0,
        now: Now = time.perf_counter,
        sleep: Sleep = time.sleep,
    ) -> None:
        self.source, self.rate_hz = source, require_range("rate_hz", rate_hz, low=0.1, high=1000.0)
        self._now, self._sleep = now, sleep
        self._zero, self._number = math.nan, 0

    def open(self) -> None:
        """The first call is time zero of the source."""
        if math.isnan(self._zero):
            self._zero = self._now()

    def read(self) -> Pixels | None:
        """The next image's pixels; None if the source has none."""
        t = self._number / self.rate_hz
        _sleep_until(self._zero + t, self._now, self._sleep)
        self._number = max(
            self._number + 1, math.ceil((self._now() - self._zero) * self.rate_hz - 1e-6)
        )
        image = self.source.next_image(t)
        return None if image is None else image.pixels

    def close(self) -> None:
        """Nothing to release."""


@dataclass(frozen=True)
class CameraFault:
    """A fault of a fake camera between two times since it was first opened."""

    kind: Literal["unplug", "freeze", "delay", "drop", "hang", "noise"]
    begin: float  # [s]
    end: float  # [s]
    amount: float = 0.0  # delay: of the frames [s]; noise: SNR of the analog link [dB]

    def __post_init__(self) -> None:
        require_range("begin", self.begin, low=0.0)
        require_range("end", self.end, low=self.begin)
        require_range("amount", self.amount, low=0.0)


class FakeCamera:
    """A scripted camera: a moving scene with the frame's number as a bar code, and faults.

    unplug: reads return None and opening fails; freeze: the image is repeated; delay: images are
    late; drop: images are lost; hang: one read lasts until the end of the fault; noise: images pass
    through `AnalogVideo`.

    Args:
        faults: kinds and times.
        size: (width, height) [px].
        rate_hz: frames per second.
        seed: of scene and noise.
        now: the clock [s].
        sleep: waits [s].

    Raises:
        InputError: the size is below 64 x 48, or the rate is not a number from 0.1 to 1000.
    """

    def __init__(
        self,
        faults: Sequence[CameraFault] = (),
        size: tuple[int, int] = (320, 240),
        rate_hz: float = 20.0,
        seed: int = 0,
        now: Now = time.perf_counter,
        sleep: Sleep = time.sleep,
    ) -> None:
        width, height = size
        require_range("width", width, low=64, high=4096)
        require_range("height", height, low=48, high=4096)
        self.faults, self.seed = tuple(faults), seed
        self.rate_hz = require_range("rate_hz", rate_hz, low=0.1, high=1e3)
        self._now, self._sleep = now, sleep
        self._scene = _scene(width, height, seed)
        self._zero, self._number, self._shown = math.nan, -1, 0

    @property
    def t(self) -> float:
        """Time since it was first opened [s]."""
        return self._now() - self._zero

    def open(self) -> None:
        """Open; OSError while it is unplugged."""
        if math.isnan(self._zero):
            self._zero = self._now()
        if self._fault("unplug", self.t):
            raise OSError("fake camera: unplugged")

    def read(self) -> Pixels | None:
        """The next frame when it is due, with the scripted faults."""
        while True:
            self._number = max(self._number + 1, math.floor(self.t * self.rate_hz + 1e-6))
            t = self._number / self.rate_hz
            _sleep_until(self._zero + t, self._now, self._sleep)
            if self._fault("unplug", t):
                return None
            if hang := self._fault("hang", t):
                self._sleep(hang.end - t)
            elif not self._fault("drop", t):
                break
        if late := self._fault("delay", t):
            self._sleep(late.amount)
        if not self._fault("freeze", t):
            self._shown = self._number
        pixels = self.picture(self._shown)
        noise = self._fault("noise", t)
        return AnalogVideo(noise.amount, self.seed).apply(pixels, self._number) if noise else pixels

    def close(self) -> None:
        """Nothing to release."""

    def picture(self, number: int) -> Pixels:
        """The frame with this number (H, W, 3), without faults."""
        height, width = self._scene.shape[0], self._scene.shape[1] // 2
        start = round(number * SPEED_PX) % width  # the scene repeats after one width
        pixels = self._scene[:, start : start + width].copy()
        bits = (number >> np.arange(CODE_BITS)) & 1
        columns = np.arange(width) * CODE_BITS // width
        pixels[: height // 6] = (255 * bits[columns]).astype(np.uint8)[None, :, None]
        return pixels

    def _fault(self, kind: str, t: float) -> CameraFault | None:
        return next(
            (f for f in self.faults if f.kind == kind and f.begin <= t + 1e-9 < f.end), None
        )


def open_camera(name: str) -> VideoCamera | VideoFile:
    """The camera with this number or device path, or the video file.

    Raises:
        FileNotFoundError: there is no such file.
        InputError: the file is no video.
    """
    if name.isdigit():
        return VideoCamera(int(name))
    return VideoCamera(name) if name.startswith("/dev/") else VideoFile(name)


def _scene(width: int, height: int, seed: int) -> Pixels:
    """A smooth coloured scene (H, 2 W, 3) with period W."""
    import cv2

    rng = np.random.default_rng([seed, 0])
    scene = np.tile(rng.uniform(0.0, 255.0, (height, width, 3)).astype(np.float32), (1, 3, 1))
    blurred = cv2.GaussianBlur(scene, (0, 0), max(width / 80.0, 1.5))
    blurred = blurred[:, width // 2 : width // 2 + 2 * width]  # free of the blur's border
    contrast = 45.0 * (blurred - blurred.mean()) / blurred.std()
    return np.clip(128.0 + contrast, 0, 255).astype(np.uint8)


def _read_rgb(capture: Any) -> Pixels | None:
    import cv2

    success, pixels = capture.read()
    return np.asarray(cv2.cvtColor(pixels, cv2.COLOR_BGR2RGB), np.uint8) if success else None


def _sleep_until(t: float, now: Now, sleep: Sleep) -> None:
    if t > now():
        sleep(t - now())
