"""Room: the people of a class and what they ask -> requests to the session, answers to the pages.

Names, the queue for the sticks, the teacher's rights, the flights so far and the scene's file. The
server calls it in its own thread, the session in another; a third computes what takes long.
"""

import gzip
import json
import math
import re
import subprocess
import sys
import tempfile
import threading
import time
from collections import deque
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

from falconwing_kit import __version__
from falconwing_kit.aircraft.touchdown import LandingPad
from falconwing_kit.control.guidance import Hall
from falconwing_kit.core.messages import Image, State
from falconwing_kit.flight.loop import LoopStep
from falconwing_kit.flight.sources import fpv_camera
from falconwing_kit.scene.gaussians import GaussianScene
from falconwing_kit.tools.classroom import channel
from falconwing_kit.tools.classroom.after_flight import AfterFlight
from falconwing_kit.tools.classroom.channel import SticksMessage, write_text
from falconwing_kit.tools.classroom.hands import Hands
from falconwing_kit.tools.classroom.pictures import Pictures
from falconwing_kit.tools.classroom.qr import qr_svg
from falconwing_kit.tools.classroom.results import FlightRecord
from falconwing_kit.tools.classroom.server import NAME_LENGTH, Body, Client, Server
from falconwing_kit.tools.classroom.session import PHASES, Session, class_effects
from falconwing_kit.tools.classroom.take_over import SILENCE_S
from falconwing_kit.tools.cli.scene_input import open_scene

SCENE_URL = "/scene.bin"  # as scene_file.py packs it, in gzip
MAX_FLIGHTS = 200  # that the pages can ask for
KEPT_EVENTS = 30  # sent to a page that joins
FLIGHT_PATH = re.compile(r"/flights/(\d{1,6})\.(json|html|mcap)")
TEACHERS = ("give", "take", "pause", "speed", "restart", "record", "effect", "task", "end")


@dataclass(eq=False)
class Room:
    """Everyone who is connected, and everything that was flown."""

    hands: Hands
    hall: Callable[[], GaussianScene | None]  # the scene as soon as it is there
    scene: str  # its name
    scene_file: Callable[[], bytes | None]  # for the pages, in gzip
    folder: Path  # of the logs
    server: Server | None = None  # set before the server starts
    session: Session | None = None  # set before it runs
    school: bool = True  # whether there are seats; else a page shows flights only
    simulated: bool = True
    has_poses: bool = True  # else the pages show the camera's pictures
    names: dict[int, str] = field(default_factory=dict)
    queue: list[int] = field(default_factory=list)  # clients that asked for the sticks
    records: dict[int, FlightRecord] = field(default_factory=dict)

    def __post_init__(self) -> None:
        self._lock = threading.Lock()
        self._who: dict[str, Any] = {"holder": "nobody", "name": "", "client": 0, "reason": ""}
        self._last: dict[str, dict[str, Any]] = {}  # newest message of some kinds, for newcomers
        self._events: deque[dict[str, Any]] = deque(maxlen=KEPT_EVENTS)
        self._ignored: set[int] = set()  # clients whose sticks without leave were reported
        self._worker = ThreadPoolExecutor(1, "after the flight")
        self._after = AfterFlight(self.folder)
        self.pictures = Pictures(self.hall, self._send_picture, self._wants_pictures)

    def close(self) -> None:
        """End the threads of the room."""
        self.pictures.close()
        self._worker.shutdown(wait=False, cancel_futures=True)
        self._after.close()

    # Publisher: called in the session's thread
    # -----------------------------------------

    def state(self, data: bytes) -> None:
        """A step for all pages."""
        if self.server is not None:
            self.server.send_state(data)

    def text(self, kind: str, **fields: Any) -> None:
        """A message of the session for all pages; the newest is kept for those who join."""
        if kind == "who":
            self._who = fields
            self._send_who()
            return
        if kind == "event":
            self._events.append(fields)
        elif kind in ("flight", "verdict", "effects"):
            self._last[kind] = fields
        if kind == "flight":
            self._last.pop("verdict", None)
            if fields["number"] == 1 and self.school:
                self._worker.submit(self._warm)
            self._who |= {"holder": self.hands.holder}
            self._send_who()
        self.send(kind, **fields)

    def step(self, session: Session, step: LoopStep, truth: State) -> None:
        """A step for the picture of the nose."""
        self.pictures.show(session, step, truth)

    def finished(self, record: FlightRecord) -> None:
        """A flight whose log is complete: its data and the board follow in another thread."""
        self.records[record.number] = record
        while len(self.records) > MAX_FLIGHTS:
            self.records.pop(min(self.records))
        self._worker.submit(self._finish, record)
        if self.queue and not self._has_desk():
            owner = self.hands.owner
            if owner and self.names.get(owner, "") in record.holders:
                self.hands.leave(owner)  # one flight each while others wait
            self._give_next()

    def _warm(self) -> None:
        with suppress(RuntimeError):  # the class ended in between
            self._after.warm()

    def _finish(self, record: FlightRecord) -> None:
        with suppress(Exception):
            self._after.data(record)
            rows = self._after.add(record)
            self._last["board"] = {"rows": rows}
            self.send("board", rows=rows)

    # Class: called in the server's thread
    # ------------------------------------

    def hello(self, client: Client) -> list[str]:
        """What a new page gets first."""
        texts = [self._hello(client)]
        texts += [write_text(kind, **fields) for kind, fields in dict(self._last).items()]
        texts += [write_text("event", **fields) for fields in list(self._events)[-KEPT_EVENTS:]]
        texts.append(write_text("who", **self._who_fields()))
        return texts

    def joined(self, client: Client) -> None:
        """Give a newcomer a name."""
        client.name = f"{client.role.capitalize()} {client.number}"
        self.names[client.number] = client.name
        self._count_clients()

    def left(self, client: Client) -> None:
        """Forget a client; its turn is over."""
        self.names.pop(client.number, None)
        self._leave_queue(client.number)
        self.hands.leave(client.number)
        self._ignored.discard(client.number)
        self._count_clients()

    def sticks(self, client: Client, sticks: SticksMessage) -> None:
        """Pass sticks on; those without leave are ignored, and logged once."""
        if client.number != self.hands.owner and client.number not in self._ignored and sticks.hold:
            self._ignored.add(client.number)
            if self.session is not None:
                self.session.request("ignored", self.names.get(client.number, ""))
        self.hands.sticks(client.number, sticks)

    def text_from(self, client: Client, message: dict[str, Any]) -> None:
        """Do what a page asks, if it may."""
        kind = message["type"]
        if kind == "name":
            self._rename(client, message.get("name"))
        elif kind == "ask":
            self._ask(client)
        elif kind == "leave":
            self._leave_queue(client.number)
            self.hands.leave(client.number)
            self._send_who()
        elif kind == "assist":
            if client.number == self.hands.owner:
                self.hands.set_assist(message.get("on") is True)
        elif kind == "gap":
            self._ask_gap(client, message.get("flight"))
        elif kind in TEACHERS and client.role == "desk":
            self._teach(client, kind, message)
        else:
            client.counts["not understood"] += 1

    def body(self, path: str) -> Callable[[], Body | None] | None:
        """What a path of HTTP answers beyond the static files."""
        if path == SCENE_URL:
            return self._scene_body
        if path == "/qr.svg":
            return self._qr
        if path == "/flights.json":
            return self._list_flights
        found = FLIGHT_PATH.fullmatch(path)
        if found is None or int(found[1]) not in self.records:
            return None
        record, ending = self.records[int(found[1])], found[2]
        return lambda: self._flight_body(record, ending)

    # The people
    # ----------

    def _rename(self, client: Client, name: Any) -> None:
        if not isinstance(name, str):
            return
        text = "".join(letter for letter in name if letter.isprintable()).strip()[:NAME_LENGTH]
        client.name = self.names[client.number] = text or client.name
        if client.number == self.hands.owner:
            self.hands.give(client.number, client.name)
        self._send_who()

    def _ask(self, client: Client) -> None:
        with self._lock:
            if client.number not in self.queue and client.number != self.hands.owner:
                self.queue.append(client.number)
        if not self.hands.owner and not self._has_desk():
            self._give_next()
        self._send_who()

    def _give_next(self) -> None:
        """Let the first of the queue fly."""
        with self._lock:
            number = next((one for one in self.queue if one in self.names), 0)
            self.queue = [one for one in self.queue if one in self.names and one != number]
        if number and not self.hands.owner:
            self.hands.give(number, self.names[number])
        self._send_who()

    def _leave_queue(self, number: int) -> None:
        with self._lock:
            self.queue = [one for one in self.queue if one != number]

    def _has_desk(self) -> bool:
        return self.server is not None and self.server.has_role("desk")

    def _teach(self, client: Client, kind: str, message: dict[str, Any]) -> None:
        """The teacher's messages; one with a wrong field is counted and left."""
        session, on, value = self.session, message.get("on") is True, message.get("value")
        number = message.get("client")
        if session is None:
            return
        flew = self.hands.holder == "student"
        if kind == "give" and isinstance(number, int) and number in self.names:
            self._leave_queue(number)
            self.hands.give(number, self.names[number])
        elif kind == "take":
            self.hands.take()
        elif kind in ("pause", "record"):
            session.request(kind, on)
        elif kind == "speed" and isinstance(value, (int, float)) and math.isfinite(value):
            session.request("speed", value)
        elif kind == "effect" and isinstance(message.get("name"), str):
            session.request("effect", (message["name"], on))
        elif kind == "task" and isinstance(message.get("task"), str):
            session.request("task", (message["task"], str(message.get("manoeuvre") or "")))
        elif kind in ("restart", "end"):
            session.request(kind)
        else:
            client.counts["not understood"] += 1
        if flew and self.hands.holder != "student":
            session.request("step")  # the student's command acts no longer than that takes
        self._send_who()

    def _ask_gap(self, client: Client, number: Any) -> None:
        record = self.records.get(number) if isinstance(number, int) else None
        if record is None:
            self.send_to(client, "error", text="There is no flight of this number any more.")
            return
        self._after.name_missing(record, lambda answer: self.send("gap", **answer))

    # Messages
    # --------

    def send(self, kind: str, **fields: Any) -> None:
        """A message to all pages."""
        if self.server is not None:
            self.server.send_text(write_text(kind, **fields))

    def send_to(self, client: Client, kind: str, **fields: Any) -> None:
        """A message to one page."""
        if self.server is not None:
            self.server.send_text(write_text(kind, **fields), client=client.number)

    def preparing(self, share: float, text: str) -> None:
        """Say how far the preparation is; a share of 1 ends it."""
        self._last["preparing"] = {"share": share, "text": text}
        self.send("preparing", share=share, text=text)
        if share >= 1.0 and self.server is not None:  # the scene's address is in the greeting
            for client in list(self.server.clients.values()):
                self.server.send_text(self._hello(client), client=client.number)

    def _who_fields(self) -> dict[str, Any]:
        queue = [{"client": n, "name": self.names[n]} for n in list(self.queue) if n in self.names]
        who = {**self._who, "holder": self.hands.holder}
        return {**who, "queue": queue, "owner_may": self.hands.owner}

    def _send_who(self) -> None:
        self.send("who", **self._who_fields())

    def _count_clients(self) -> None:
        if self.server is None:
            return
        roles = [client.role for client in self.server.clients.values()]
        counts = {
            f"{role}s" if role != "wall" else "wall": roles.count(role) for role in set(roles)
        }
        fields = {"wall": 0, "seats": 0, "desks": 0} | counts
        self.server.send_text(write_text("clients", **fields), role="desk")

    def _hello(self, client: Client) -> str:
        pad, hall, session = LandingPad(), Hall(), self.session
        camera = fpv_camera()
        scene = self.scene_file()
        fov = math.degrees(2.0 * math.atan(0.5 * camera.width / camera.fx))
        task = session.task if session is not None else None
        mount = task.airframe.p_body_camera if task is not None else (0.2, 0.0, 0.0)
        return write_text(
            "hello", client=client.number, role=client.role, name=client.name, scene=self.scene,
            task=task.name if task is not None else "",
            simulated=self.simulated, school=self.school, has_poses=self.has_poses,
            scene_url=SCENE_URL if scene is not None else None,
            scene_bytes=len(scene) if scene is not None else 0,
            pad={
                "x0": pad.x_start, "x1": pad.x_start + pad.length,
                "y0": pad.y_centre - pad.width / 2.0, "y1": pad.y_centre + pad.width / 2.0,
                "z": pad.height,
            },
            hall={"x": list(hall.x), "y": list(hall.y), "z": [0.0, hall.height]},
            camera={"p_body_camera": list(mount), "fov_deg": fov, "pitch_deg": 0.0},
            effects=[{"name": e.name, "physics": e.physics} for e in class_effects()],
            version=__version__, stick_timeout_ms=round(1e3 * SILENCE_S), phases=list(PHASES),
        )  # fmt: skip

    # Files
    # -----

    def _scene_body(self) -> Body | None:
        data = self.scene_file()
        return None if data is None else Body(data, ".bin", is_gzip=True)

    def _qr(self) -> Body | None:
        """The address for students as a picture, for the wall."""
        if self.server is None:
            return None
        return Body(qr_svg(self.server.url("/")), ".svg")

    def _list_flights(self) -> Body:
        rows = [
            {**asdict(record), "log": record.log.name} for record in list(self.records.values())
        ]
        return Body(json.dumps(channel.plain(rows)).encode(), ".json")

    def _flight_body(self, record: FlightRecord, ending: str) -> Body | None:
        name = f"flight_{record.number:04d}.{ending}"
        if ending == "mcap":
            return Body(record.log.read_bytes(), ".mcap", download=name)
        if ending == "json":
            return Body(gzip.compress(self._after.data(record), 5), ".json", is_gzip=True)
        page = self._after.share_page(record, self.scene_file())
        return Body(page.encode(), ".html", download=name)

    def _send_picture(self, flight: int, image: Image) -> None:
        if self.server is not None:
            self.server.send_picture(channel.pack_picture(flight, image.sequence, image.jpeg))

    def _wants_pictures(self) -> bool:
        return self.server is not None and self.server.wants_pictures()


class SceneJob:
    """The hall: loaded and packed for the pages in another process, so that the flight goes on."""

    def __init__(self, name: str, report: Callable[[float, str], None]) -> None:
        """Begin; report: how far it is, and a sentence."""
        self.name, self._report = name, report
        self.scene: GaussianScene | None = None
        self.packed: bytes | None = None
        self._folder = tempfile.TemporaryDirectory(prefix="falconwing_scene_")
        self._process: subprocess.Popen[bytes] | None = None
        self._ended = False
        self._thread = threading.Thread(target=self._run, name="scene", daemon=True)
        self._thread.start()

    def close(self) -> None:
        """Give up what is not ready, and remove the files."""
        self._ended = True
        if self._process is not None and self._process.poll() is None:
            self._process.terminate()
        self._thread.join(5.0)
        self._folder.cleanup()

    def _run(self) -> None:
        file = Path(self._folder.name) / "scene.bin.gz"
        begin = time.monotonic()
        try:
            self._process = subprocess.Popen(
                [sys.executable, "-m", "falconwing_kit.tools.classroom.pack_scene",
                 self.name, str(file)],
                stdin=subprocess.DEVNULL, stderr=subprocess.DEVNULL, start_new_session=True,
            )  # fmt: skip
            while self._process.poll() is None and not self._ended:
                seconds = time.monotonic() - begin
                # The arena is built once a machine, which takes about 40 s on two busy cores.
                share = 1.0 - math.exp(-seconds / 20.0)
                self._report(share, f"the hall is being prepared, {seconds:.0f} s so far")
                with suppress(subprocess.TimeoutExpired):
                    self._process.wait(1.0)
            if self._ended:
                return
            if self._process.returncode:
                self._report(1.0, "the hall cannot be loaded, so it is not shown")
                return
            if file.exists():
                self.packed = file.read_bytes()
            self.scene = open_scene(self.name)
            self._report(1.0, "the hall is ready")
        except OSError as error:
            self._report(1.0, f"the hall is not shown: {error}")
