"""Grabber: a camera that may block, stall or vanish -> its newest picture, at once, and how healthy
it is.

A thread reads the camera and keeps only the newest frame, so a slow consumer sees fresh pictures
and counts the ones it missed, instead of working through a queue of old ones. Whether a camera is
alive is told by the age of its newest frame alone: an unplugged one goes on saying that it is open.
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

MIN_WAIT, MAX_WAIT = (
    0.1,
    2.0,
)  # s before the first and the later attempts to open again; each twice the last
STOP_WAIT = 2.0  # s that `stop` waits for a camera that is stuck in a read


class Camera(Protocol):
    """What a grabber reads."""

    def open(self) -> None:
        """Open or reopen; OSError where it is not there."""

    def read(self) -> NDArray[np.uint8] | None:
        """Wait for the next frame (H, W, 3) RGB; None where the camera is gone, EOFError where it
        is over for good.
        """

    def close(self) -> None:
        """Let go of it; never raises."""


@dataclass(frozen=True)
class CameraHealth:
    """How a camera does."""

    alive: bool  # its newest frame is fresh
    age: float  # of the newest frame [s]; infinite before the first
    received: int  # frames since the start
    dropped: int  # frames that a newer one replaced before anybody took them
    reconnects: int  # times that it was opened again
    trouble: str  # the last thing that went wrong; empty where nothing has


class Grabber:
    """Reads a camera in a thread; an image source of the loop, which it never keeps waiting and
    never throws at.

        with Grabber(VideoCamera(0)) as camera:
            Loop(pilot, sink, images=camera, clock=WallClock()).run(60.0)

    Args:
        camera: what to read; the grabber opens and closes it.
        stale_s: a newest frame older than this counts as none [s].
        now: the clock that frames are stamped by [s].
        pause: waits before opening again [s]; None waits so that `stop` interrupts it.
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
        self._stamp, self._image, self._taken = (
            -math.inf,
            Image(-1, -math.inf, np.zeros(0, np.uint8)),
            True,
        )
        self._received = self._dropped = self._reconnects = 0
        self._trouble = ""
        self._thread = threading.Thread(target=self._run, name="grabber", daemon=True)

    def start(self) -> "Grabber":
        """Begin to read; returns at once, also where there is no camera yet."""
        self._thread.start()
        return self

    def stop(self) -> bool:
        """End the thread and close the camera.

        Returns:
            Whether it ended; False where the camera is stuck in a read. The thread then ends with
            the read.
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
        """The newest image, at once; the same one again while there is no newer one.

        Args:
            t: now, on the loop's clock [s]; the image's time is put on that clock when it is first
                given out.

        Returns:
            The image with its pixels (H, W, 3) RGB; None before the first and where the newest is
            stale.
        """
        with self._fresh:
            age = self._now() - self._stamp
            if self._newest is None or age > self.stale_s:
                return None
            if not self._taken:
                self._image, self._taken = Image(self._received - 1, t - age, self._newest), True
            return self._image

    def wait(self, received: int, timeout: float) -> bool:
        """Wait until so many frames have come since the start, or the timeout [s] or the end; True
        if they have.
        """
        with self._fresh:
            return self._fresh.wait_for(
                lambda: self._received >= received or self._stopping.is_set(), timeout
            ) and (self._received >= received)

    @property
    def health(self) -> CameraHealth:
        """How the camera does now."""
        with self._fresh:
            age = self._now() - self._stamp
            alive = age <= self.stale_s
            return CameraHealth(
                alive, age, self._received, self._dropped, self._reconnects, self._trouble
            )

    def _run(self) -> None:
        """Open, read until the camera is gone, wait a little longer each time, and again."""
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
            except Exception as error:  # whatever a driver throws, the loop flies on
                self._note(f"{type(error).__name__}: {error}")
            finally:
                with suppress(Exception):  # a driver that throws here too must not end the thread
                    self._camera.close()
            attempts += 1
            self._pause(wait)
            wait = min(2.0 * wait, MAX_WAIT)

    def _read_on(self) -> None:
        """Keep the newest frame until the camera is gone."""
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
