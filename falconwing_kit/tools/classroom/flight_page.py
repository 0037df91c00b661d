"""Flight page: the steps of flights, or a log -> the class's wall or player, for this machine only.

The pages, their server and their protocol are those of `falconwing class`; here nobody takes the
sticks, so there are no seats and no desk.
"""

import gzip
import tempfile
import threading
import time
import warnings
import webbrowser
from collections import deque
from contextlib import suppress
from pathlib import Path

import numpy as np

from falconwing_kit.core.checks import require_range
from falconwing_kit.core.messages import CONTROL_PERIOD_S, Image, State
from falconwing_kit.flight.loop import LoopStep
from falconwing_kit.scene.gaussians import GaussianScene
from falconwing_kit.tools.classroom import channel
from falconwing_kit.tools.classroom.hands import Hands
from falconwing_kit.tools.classroom.results import record_of_log
from falconwing_kit.tools.classroom.room import Room
from falconwing_kit.tools.classroom.scene_file import scene_bytes
from falconwing_kit.tools.classroom.server import Server
from falconwing_kit.tools.classroom.session import STRETCH

REPEAT_S = 0.3  # without a step, after which the newest is sent again
HALL_S = 60.0  # a browser's time to draw the hall, once it has the page
LEFT_S = 5.0  # without a browser, after which a page that is kept is closed
NO_POSE = State.from_vector(np.full(9, np.nan))
WALL, PLAYER = "wall.html", "flight.html"


class FlightPage:
    """A page on this machine: `show(step)` for every step of a flight, and `close()` at the end."""

    def __init__(
        self, scene: str = "arena", port: int = 8080, *, page: str = WALL, task: str = "",
        simulated: bool = True, has_poses: bool = True,
    ) -> None:  # fmt: skip
        """Serve the page.

        Args:
            scene: name of the hall; its Gaussians follow by `set_scene`.
            port: TCP port; the next free one of ten if it is taken, with a warning.
            page: WALL for a flight as it goes, PLAYER for the flight of `add_log`.
            task: what is flown, as the page names it.
            simulated: whether the page says SIMULATION, or REAL AIRCRAFT.
            has_poses: whether poses are known; else it is the replay of a log of pictures.

        Raises:
            InputError: the port is not in 1024..65000, or none of ten is free.
        """
        wanted = int(require_range("port", port, low=1024, high=65000))
        self._folder = tempfile.TemporaryDirectory(prefix="falconwing_flight_")
        self._packed: bytes | None = None
        self._room = Room(
            Hands(), lambda: None, scene, lambda: self._packed, Path(self._folder.name),
            school=False, simulated=simulated, has_poses=has_poses,
        )  # fmt: skip
        if not has_poses:
            self._room.hands.end()  # nobody holds the sticks of a flight that is over
        self._room.preparing(0.0, "the hall is being prepared")
        self._server = Server(self._room, port=wanted, pages={"/": page}, roles=("wall",))
        self._room.server = self._server
        self._server.start()
        self.url = self._server.url("/")
        if self._server.port != wanted:
            warnings.warn(f"port {wanted} is taken, so the page is at {self.url}", stacklevel=2)
        self._task, self._number, self._phases = task, 0, [""]
        self._last: tuple[LoopStep, State] | None = None
        self._times: deque[float] = deque(maxlen=21)  # real times of the newest steps [s]
        self._image: Image | None = None
        self._shown_at, self._flags = 0.0, 0
        self._closing = threading.Event()
        self._thread = threading.Thread(target=self._repeat, name="flight page", daemon=True)
        self._thread.start()

    def __enter__(self) -> "FlightPage":
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """End the server."""
        self._closing.set()
        self._thread.join()
        self._server.close()
        self._room.close()
        self._folder.cleanup()

    def set_scene(self, scene: GaussianScene) -> None:
        """Show a hall, in the kit's world frame."""
        self._packed = gzip.compress(scene_bytes(scene), 1)
        self._room.preparing(1.0, "the hall is ready")

    def add_log(self, log: Path, number: int = 0) -> None:
        """Offer a log to the player as flight `number`, the newest one if not given.

        Raises:
            FileNotFoundError: there is no log.
            InputError: it is no log of the kit.
        """
        number = number or max(self._number, 1)
        self._room.records[number] = record_of_log(log, number)

    def open(self) -> bool:
        """Open the page in this machine's browser; False if there is none."""
        return webbrowser.open(self.url)

    def wait_for_viewer(self, seconds: float) -> bool:
        """Wait at most `seconds` until a browser has the page, and then HALL_S until it shows the
        hall, which takes long without a GPU; False if none has the page.
        """
        begin = time.monotonic()
        while True:
            clients, waited = list(self._server.clients.values()), time.monotonic() - begin
            limit = seconds + HALL_S if clients else seconds
            if any(client.ready for client in clients) or waited > limit:
                return bool(clients)
            time.sleep(0.05)

    def show(self, step: LoopStep) -> None:
        """Show a step; a page that is behind misses it, and the flight never waits.

        Args:
            step: of the loop; an earlier time than the last step's starts a new flight.
        """
        if self._last is None or step.t < self._last[0].t:
            self._number += 1
            self._times.clear()
            self._publish_flight()
        if step.mode not in self._phases:
            self._phases.append(step.mode)
            self._publish_flight()
        state = NO_POSE if step.state is None else step.state
        self._last, self._flags, self._shown_at = (step, state), 0, time.monotonic()
        self._times.append(time.perf_counter())
        self._send()
        if step.image is not None and step.image is not self._image:
            self._image = step.image
            self._send_picture()

    def say(self, verdict: str, success: bool | None = None) -> None:
        """Show a verdict; None for neither success nor failure."""
        self._room.text(
            "verdict", flight=max(self._number, 1), sentence=verdict, success=success, numbers={},
            holders=[], logged=None, again=bool(self._room.records),
        )  # fmt: skip
        self._flags = channel.OVER
        self._send()

    def keep(self, verdict: str, success: bool | None = None) -> None:
        """Show a verdict, and return when Ctrl-C is pressed or no browser shows the page."""
        self.say(verdict, success)
        self.wait(ends_alone=True)

    def wait(self, *, ends_alone: bool = False) -> None:
        """Return when Ctrl-C is pressed; also, if `ends_alone`, soon after the page was closed."""
        seen = time.monotonic()
        with suppress(KeyboardInterrupt):
            while not ends_alone or time.monotonic() - seen < LEFT_S:
                seen = time.monotonic() if self._server.clients else seen
                time.sleep(0.1)

    def _repeat(self) -> None:
        """While nothing moves, show the newest step to a browser that has just come."""
        while not self._closing.wait(REPEAT_S):
            if time.monotonic() - self._shown_at > REPEAT_S:
                self._send()
                self._send_picture()

    def _publish_flight(self) -> None:
        self._room.text(
            "flight", number=self._number, task=self._task, phases=self._phases, effects=[],
            manoeuvre="",
        )  # fmt: skip

    def _send_picture(self) -> None:
        if self._image is not None and self._server.wants_pictures():
            jpeg = self._image.jpeg
            self._server.send_picture(
                channel.pack_picture(self._number, self._image.sequence, jpeg)
            )

    def _send(self) -> None:
        """Send the newest step."""
        if self._last is None:
            return
        (step, state), flags = self._last, self._flags
        spent = self._times[-1] - self._times[0]
        rate = (len(self._times) - 1) / spent if spent > 0.0 else 0.0
        is_late = len(self._times) > 5 and rate * STRETCH * CONTROL_PERIOD_S < 1.0
        flags |= channel.STRETCHED * (is_late and not flags)
        self._room.state(
            channel.pack_state(
                flags=flags, holder=self._room.hands.holder, flight=self._number,
                phase=self._phases.index(step.mode), step=round(step.t / CONTROL_PERIOD_S),
                t=step.t, state=state, command=step.command, leader=step.leader, rate_hz=rate,
            )
        )  # fmt: skip
