"""A tiny class for tests of the pages: its files and a WebSocket that speaks the protocol, packed
here with `struct`, apart from the kit's own server.
"""

import asyncio
import json
import math
import queue
import struct
import threading
from collections.abc import Sequence
from http import HTTPStatus
from pathlib import Path
from typing import Any
from urllib.parse import parse_qs, urlsplit

import cv2
import numpy as np
from websockets.asyncio.server import ServerConnection, serve
from websockets.datastructures import Headers
from websockets.exceptions import ConnectionClosed
from websockets.http11 import Request, Response

import falconwing_kit

PAGE = Path(falconwing_kit.__file__).parent / "tools" / "classroom" / "page"
TYPES = {
    ".html": "text/html",
    ".js": "text/javascript",
    ".css": "text/css",
    ".svg": "image/svg+xml",
}
POLICY = (
    "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self' data: blob:; "
    "worker-src blob:; connect-src 'self'; base-uri 'none'; form-action 'none'"
)
HELLO = {
    "type": "hello", "name": "", "scene": "arena", "task": "landing", "simulated": True,
    "scene_url": "/scene.bin", "scene_bytes": 1000, "version": "0", "stick_timeout_ms": 200,
    "pad": {"x0": -1.5, "x1": 1.5, "y0": -1.0, "y1": 1.0, "z": 0.0},
    "hall": {"x": [-22.5, 17.5], "y": [-12.0, 8.0], "z": [0.0, 5.0]},
    "camera": {"p_body_camera": [0.1, 0.0, 0.0], "fov_deg": 90.0, "pitch_deg": -10.0},
    "phases": ["approach", "flare", "landed"],
    "effects": [
        {"name": "wind", "physics": "The air moves as a whole over the floor."},
        {"name": "drag", "physics": "More drag than the model has."},
        {"name": "control delay", "physics": "Commands act later."},
    ],
}  # fmt: skip


def state_bytes(
    t: float,
    *,
    holder: int = 1,
    flight: int = 7,
    flags: int = 0,
    speed: float = 1.0,
    phase: int = 0,
) -> bytes:
    """A state of an aircraft that circles at 1.2 m with 3 m/s on a radius of 4 m."""
    angle = 3.0 / 4.0 * t
    x, y, z = -4.0 + 4.0 * math.sin(angle), -4.0 * math.cos(angle), 1.2 + 0.3 * math.sin(0.8 * t)
    pose = (x, y, z, -0.22, 0.05, -angle)
    velocity = (3.0 * math.cos(angle), 3.0 * math.sin(angle), 0.24 * math.cos(0.8 * t))
    command = (0.55, 0.3 * math.sin(t), 0.2 * math.cos(t), -0.1)
    return struct.pack(
        "<BBBBHHf21f", 1, flags, holder, phase, flight, int(20 * t) % 65536, t,
        *pose, *velocity, *command, *(math.nan,) * 6, 20.0, speed,
    )  # fmt: skip


def picture_bytes(sequence: int) -> bytes:
    """A grey picture with a brighter square, as a JPEG behind its head."""
    image = np.full((240, 320, 3), 90, np.uint8)
    image[100:140, 140:180] = 220
    return struct.pack("<BBHI", 2, 0, 7, sequence) + cv2.imencode(".jpg", image)[1].tobytes()


class FakeClass:
    """Serves the pages and notes what they send; `stubs` stand in for files of `folders`."""

    def __init__(self, stubs: dict[str, str], folders: Sequence[Path] = (PAGE,)) -> None:
        self.stubs, self.folders = stubs, folders
        self.texts: queue.Queue[tuple[str, dict[str, Any]]] = queue.Queue()
        self.binaries: queue.Queue[bytes] = queue.Queue()
        self.files: dict[str, tuple[str, bytes]] = {}
        self.hello: dict[str, Any] = dict(HELLO)
        self.first: list[dict[str, Any]] = []  # said to everybody who comes
        self.clients: dict[int, tuple[str, ServerConnection]] = {}
        self._loop = asyncio.new_event_loop()
        self._ready = threading.Event()
        self._thread = threading.Thread(target=self._run, daemon=True)

    def __enter__(self) -> "FakeClass":
        self._thread.start()
        assert self._ready.wait(20)
        return self

    def __exit__(self, *_: object) -> None:
        self._loop.call_soon_threadsafe(self._stop.set)
        self._thread.join(20)

    @property
    def url(self) -> str:
        return f"http://127.0.0.1:{self.port}"

    def say(self, message: dict[str, Any] | bytes, role: str = "") -> None:
        """To everybody, or to one role."""
        data = message if isinstance(message, bytes) else json.dumps(message)
        asyncio.run_coroutine_threadsafe(self._say(data, role), self._loop).result(20)

    def drop(self, code: int) -> None:
        """Close every connection with a code."""

        async def close() -> None:
            for _, connection in list(self.clients.values()):
                await connection.close(code)

        asyncio.run_coroutine_threadsafe(close(), self._loop).result(20)

    def next_text(self, kind: str, wait_s: float = 20.0) -> dict[str, Any]:
        """The next message of a type; others are dropped."""
        while True:
            _, message = self.texts.get(timeout=wait_s)
            if message["type"] == kind:
                return message

    async def _say(self, data: bytes | str, role: str) -> None:
        for its_role, connection in list(self.clients.values()):
            if role in ("", its_role):
                await connection.send(data)

    def _run(self) -> None:
        self._loop.run_until_complete(self._serve())

    async def _serve(self) -> None:
        self._stop = asyncio.Event()
        async with serve(
            self._meet, "127.0.0.1", 0, process_request=self._answer, compression=None
        ) as server:
            self.port = next(iter(server.sockets)).getsockname()[1]
            self._ready.set()
            await self._stop.wait()

    def _answer(self, _: ServerConnection, request: Request) -> Response | None:
        path = urlsplit(request.path).path
        if path == "/ws":
            return None
        name = {"/": "seat.html", "/wall": "wall.html", "/desk": "desk.html"}.get(
            path, path.removeprefix("/page/")
        )
        if path in self.files:
            kind, body = self.files[path]
            return self._response(HTTPStatus.OK, kind, body)
        if name in self.stubs:
            return self._response(HTTPStatus.OK, "text/javascript", self.stubs[name].encode())
        for folder in self.folders:
            if "/" not in name and (folder / name).is_file():
                return self._response(
                    HTTPStatus.OK, TYPES[Path(name).suffix], (folder / name).read_bytes()
                )
        return self._response(HTTPStatus.NOT_FOUND, "text/plain", b"")

    @staticmethod
    def _response(status: HTTPStatus, kind: str, body: bytes) -> Response:
        headers = Headers(
            {
                "Content-Type": kind, "Content-Length": str(len(body)), "Connection": "close",
                "Content-Security-Policy": POLICY, "X-Content-Type-Options": "nosniff",
            }
        )  # fmt: skip
        return Response(status, status.phrase, headers, body)

    async def _meet(self, connection: ServerConnection) -> None:
        assert connection.request is not None
        role = parse_qs(urlsplit(connection.request.path).query)["role"][0]
        client = max(self.clients, default=0) + 1
        self.clients[client] = (role, connection)
        await connection.send(json.dumps({**self.hello, "client": client, "role": role}))
        for message in self.first:
            await connection.send(json.dumps(message))
        try:
            async for data in connection:  # until it ends, in whatever way
                if isinstance(data, bytes):
                    self.binaries.put(data)
                    continue
                message = json.loads(data)
                if message["type"] == "ping":
                    await connection.send(json.dumps({**message, "type": "pong"}))
                else:
                    self.texts.put((role, message))
        except ConnectionClosed:
            pass
        finally:
            del self.clients[client]
