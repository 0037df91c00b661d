"""Pictures: the newest step -> JPEG of the nose camera, if anyone looks; the loop never waits."""

import threading
import time
from collections.abc import Callable
from contextlib import suppress
from typing import TYPE_CHECKING

from falconwing_kit.core.messages import Image, State
from falconwing_kit.flight.loop import LoopStep
from falconwing_kit.flight.sources import RenderedView, fpv_camera
from falconwing_kit.scene.gaussians import GaussianScene

if TYPE_CHECKING:
    from falconwing_kit.tools.classroom.session import Session

PERIOD_S = 0.1  # between two pictures, at least
QUALITY = 70  # of the JPEG


class Pictures:
    """A thread that renders the newest step and leaves out those in between."""

    def __init__(
        self, hall: Callable[[], GaussianScene | None], send: Callable[[int, Image], None],
        wanted: Callable[[], bool],
    ) -> None:  # fmt: skip
        """hall: None until it is there; send: flight and picture; wanted: whether anyone looks."""
        self._hall, self._send, self._wanted = hall, send, wanted
        self._news, self._ended = threading.Event(), False
        self._newest: tuple[int, State, State | None, tuple[float, ...], Image | None] | None = None
        self._sequence = 0
        self._thread = threading.Thread(target=self._run, name="pictures", daemon=True)
        self._thread.start()

    def show(self, session: "Session", step: LoopStep, truth: State) -> None:
        """Take the newest step; returns at once."""
        if not self._wanted():
            return
        mount = tuple(session.task.airframe.p_body_camera)
        self._newest = session.flight_number, truth, step.leader, mount, step.image
        self._news.set()

    def close(self) -> None:
        """End the thread."""
        self._ended = True
        self._news.set()
        self._thread.join(5.0)

    def _run(self) -> None:
        view: RenderedView | None = None
        while True:
            self._news.wait()
            self._news.clear()
            if self._ended:
                return
            newest, begin = self._newest, time.monotonic()
            if newest is None:
                continue
            with suppress(Exception):  # no picture is worth the flight
                view = self._render(newest, view)
            time.sleep(max(0.0, begin + PERIOD_S - time.monotonic()))

    def _render(
        self,
        newest: tuple[int, State, State | None, tuple[float, ...], Image | None],
        view: RenderedView | None,
    ) -> RenderedView | None:
        """Send the picture of a step; the view is kept for the next one."""
        import cv2

        flight, truth, leader, mount, image = newest
        self._sequence += 1
        if image is not None:  # the pilot flies by images, so there is one
            pixels = image.pixels
        else:
            hall = self._hall()
            if hall is None:
                return None
            still = _StillWorld(truth, leader)
            if view is None or (view.world.leader_state is None) != (leader is None):
                view = RenderedView(still, hall, fpv_camera(), mount)
            view.world = still
            pixels = view.look()
        _, jpeg = cv2.imencode(".jpg", pixels[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, QUALITY])
        self._send(flight, Image(self._sequence, 0.0, jpeg.reshape(-1)))
        return view


class _StillWorld:
    """One moment of a flight as the world of a `RenderedView`."""

    def __init__(self, state: State, leader: State | None) -> None:
        self.state, self.leader_state = state, leader

    def advance(self, t: float) -> None:
        """Nothing moves."""

    def measured(self) -> State:
        """The true state."""
        return self.state
