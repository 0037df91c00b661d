"""Frame grabber: a camera that may block, stall or disappear -> its newest image and its health.

A thread reads the camera and keeps only the newest frame, so a slow consumer gets current images
and the number of missed ones, not a queue of old ones. Only the age of the newest frame shows
whether a camera is alive: an unplugged one still reports that it is open.
"""

import math
import threading
import time
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from types import TracebackType
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from falconwing_kit.core.checks import require_range
from falconwing_kit.core.messages import Image

MIN_WAIT, MAX_WAIT = 0.1, 2.0  # s before reopening: doubled from the first to the last
STOP_WAIT = 2.0  # s that `stop` waits for a camera that blocks in a read


class Camera(Protocol):
    """Interface of a camera for the grabber."""

    def open(self) -> None:
        """Open or reopen; OSError if it is missing."""

    def read(self) -> NDArray[np.uint8] | None:
        """Wait for the next frame (H, W, 3) RGB; None if camera is lost, EOFError at the end."""

    def close(self) -> None:
        """Release it; never raises."""


@dataclass(frozen=True)
class CameraHealth:
    """Health of a camera."""

    alive: bool  # its newest frame is fresh
    age: float  # of the newest frame [s]; infinite before the first
    received: int  # frames since the start
    dropped: int  # frames replaced by a newer one before they were taken
    reconnects: int  # number of times it was reopened
    trouble: str  # the last error; empty if there was none


class Grabber:
    """Reads a camera in a thread; an image source that never blocks and never raises.

        with Grabber(VideoCamera(0)) as camera:
            Loop(pilot, sink, images=camera, clock=WallClock()).run(60.0)

    Args:
        camera: what to read; the grabber opens and closes it.
        stale_s: maximum age of the newest frame [s].
        now: the clock for time stamps [s].
        pause: waits before reopening [s]; None for a wait that `stop` interrupts.
    """

    def __init__(
        self,
        camera: Camera,
        stale_s: float = 0.5,
        now: Callable[[], float] = time.perf_counter,
        pause: Callable[[float], object] | None = None,
    ) -> None:
        self.stale_s = require_range("stale_s", stale_s, low=0.0)
        self._camera, self._now = camera, now
        self._stopping = threading.Event()
        self._pause = pause or self._stopping.wait
        self._fresh = threading.Condition()  # guards everything below
        self._newest: NDArray[np.uint8] | None = None
        self._stamp, self._taken = -math.inf, True
        self._image = Image(-1, -math.inf, np.zeros(0, np.uint8))
        self._received = self._dropped = self._reconnects = 0
        self._trouble = ""
        self._thread = threading.Thread(target=self._run, name="grabber", daemon=True)

    def start(self) -> "Grabber":
        """Start to read; returns immediately, also without a camera."""
        self._thread.start()
        return self

    def stop(self) -> bool:
        """End the thread and close the camera.

        Returns:
            Whether it ended; False if the camera blocks in a read, with which the thread then ends.
        """
        self._stopping.set()
        with self._fresh:
            self._fresh.notify_all()
        if self._thread.ident is not None:
            self._thread.join(STOP_WAIT)
        return not self._thread.is_alive()

    def __enter__(self) -> "Grabber":
        return self.start()

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self.stop()

    def next_image(self, t: float) -> Image | None:
        """The newest image (H, W, 3) RGB without waiting; None before the first or if it is stale.

        Args:
            t: now, on the loop's clock [s]; the image's time is converted to that clock when it is
                first returned.
        """
        with self._fresh:
            age = self._now() - self._stamp
            if self._newest is None or age > self.stale_s:
                return None
            if not self._taken:
                self._image, self._taken = Image(self._received - 1, t - age, self._newest), True
            return self._image

    def wait(self, received: int, timeout: float) -> bool:
        """Wait until this number of frames was received; False after the timeout [s] or `stop`."""
        with self._fresh:
            return self._fresh.wait_for(
                lambda: self._received >= received or self._stopping.is_set(), timeout
            ) and (self._received >= received)

    @property
    def health(self) -> CameraHealth:
        """The camera's health now."""
        with self._fresh:
            age = self._now() - self._stamp
            alive = age <= self.stale_s
            return CameraHealth(
                alive, age, self._received, self._dropped, self._reconnects, self._trouble
            )

    def _run(self) -> None:
        """Open, read until the camera is lost, wait with exponential back-off, and repeat."""
        wait, attempts = MIN_WAIT, 0
        while not self._stopping.is_set():
            try:
                self._camera.open()
                self._reconnects += attempts > 0
                before = self._received
                self._read_on()
                wait = MIN_WAIT if self._received > before else wait
                self._note("the camera gave no frame")
            except EOFError:
                self._note("the video is over")
                break
            except Exception as error:  # an error of the driver must not end the thread
                self._note(f"{type(error).__name__}: {error}")
            finally:
                with suppress(Exception):
                    self._camera.close()
            attempts += 1
            self._pause(wait)
            wait = min(2.0 * wait, MAX_WAIT)

    def _read_on(self) -> None:
        """Store the newest frame until the camera is lost."""
        while not self._stopping.is_set():
            pixels = self._camera.read()
            if pixels is None:
                return
            with self._fresh:
                self._dropped += not self._taken
                self._newest, self._stamp, self._taken = pixels, self._now(), False
                self._received += 1
                self._fresh.notify_all()

    def _note(self, trouble: str) -> None:
        if not self._stopping.is_set():
            with self._fresh:
                self._trouble = trouble
