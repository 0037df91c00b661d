"""Server: HTTP and WebSocket on one port, one asyncio thread; pages and steps out, messages in.

Nothing is queued for a slow client: of states and pictures the newest is sent and the others are
left out, and a client that does not read texts is disconnected. What a client sends is counted,
limited and judged before the class sees it. On a local network every request needs the token; Host
and Origin must be the server's own address in any case.
"""

import asyncio
import hmac
import ipaddress
import logging
import math
import mimetypes
import secrets
import threading
import time
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from http import HTTPStatus
from http.cookies import CookieError, SimpleCookie
from pathlib import Path
from socket import SO_SNDBUF, SOL_SOCKET
from typing import Any, Protocol
from urllib.parse import parse_qs, urlsplit

from websockets.asyncio.server import Server as SocketServer
from websockets.asyncio.server import ServerConnection, broadcast, serve
from websockets.datastructures import Headers
from websockets.exceptions import ConnectionClosed
from websockets.http11 import Request, Response

from falconwing_kit.core.checks import InputError, require_range
from falconwing_kit.tools.classroom.channel import (
    SticksMessage,
    read_text,
    unpack_sticks,
    write_text,
)

PAGE = Path(__file__).with_name("page")
LOCAL = "127.0.0.1"
ROLES = ("wall", "seat", "desk")
PAGES = {"/": "seat.html", "/wall": "wall.html", "/desk": "desk.html"}
COOKIE = "falconwing_token"
MAX_CLIENTS, MAX_PER_ADDRESS = 60, 12  # WebSockets at once
LOCAL_PER_ADDRESS = MAX_CLIENTS  # on this machine all clients share one address
MAX_MESSAGE = 64 * 1024  # bytes
STICKS_RATE, TEXT_RATE = 120.0, 20.0  # messages a second that are heard; the others are dropped
FLOOD = 2000  # messages within a second after which a client is disconnected
STATE_BUFFER, TEXT_BUFFER = 4 * 1024, 256 * 1024  # bytes that may wait in a client's connection
PICTURE_BUFFER = 1024
SYSTEM_BUFFER = 16 * 1024  # bytes of a connection in the system
NAME_LENGTH = 24
# Time for a request and its answer, for which a flight may be flown again; between pings; to close.
OPEN_S, PING_S, CLOSE_S = 30.0, 5.0, 1.0
START_S = 10.0
POLICY = (
    "default-src 'none'; script-src 'self'; style-src 'self' 'unsafe-inline'; img-src 'self' data:"
    " blob:; media-src blob:; font-src 'self'; worker-src blob:; connect-src 'self' {sockets};"
    " base-uri 'none'; form-action 'none'; frame-ancestors 'none'"
)
TYPES = {
    ".js": "text/javascript; charset=utf-8",
    ".html": "text/html; charset=utf-8",
    ".css": "text/css; charset=utf-8",
    ".json": "application/json",
    ".svg": "image/svg+xml",
    ".bin": "application/octet-stream",
    ".mcap": "application/octet-stream",
}


@dataclass(frozen=True)
class Body:
    """What a path answers."""

    data: bytes
    kind: str  # ending that gives the content type: ".json"
    is_gzip: bool = False
    download: str = ""  # file name under which a browser saves it; empty to show it


@dataclass(eq=False)
class Client:
    """A page that is connected."""

    number: int
    role: str
    address: str
    socket: ServerConnection
    name: str = ""
    pictures: bool = False  # whether it asked for them
    ready: bool = False  # whether the hall is on its screen, or will not be
    counts: Counter[str] = field(default_factory=Counter)  # of dropped messages, by reason
    allowances: dict[str, tuple[float, float]] = field(default_factory=dict)  # token buckets
    second: tuple[int, int] = (0, 0)  # the present second and its number of messages


class Class(Protocol):
    """What a server asks of the class; called in the server's thread, so it must not wait."""

    def hello(self, client: Client) -> list[str]:
        """The texts that a new client gets first."""

    def joined(self, client: Client) -> None:
        """A client has connected."""

    def left(self, client: Client) -> None:
        """A client is gone."""

    def sticks(self, client: Client, sticks: SticksMessage) -> None:
        """A client's sticks."""

    def text_from(self, client: Client, message: dict[str, Any]) -> None:
        """A client's message with a "type"; its other fields are not checked."""

    def body(self, path: str) -> Callable[[], Body | None] | None:
        """What computes the answer of a path, in a thread of its own; None where there is none."""


class Server:
    """One port of this machine, from `start` to `close`."""

    def __init__(
        self, room: Class, *, host: str = LOCAL, port: int = 8080, lan: bool = False,
        key: str = "", token: str = "", page: Path = PAGE,
        pages: Mapping[str, str] = PAGES, roles: Sequence[str] = ROLES,
    ) -> None:  # fmt: skip
        """Prepare a server.

        Args:
            room: the class.
            host: the one address to bind.
            port: TCP port; 0 for any. If it is taken, the next free one of ten.
            lan: whether other machines may connect: then every request needs the token.
            key: the teacher's; "" for a new one.
            token: "" for a new one of 128 bits.
            page: folder of the static files.
            pages: paths and their files; roles: of pages that may connect.

        Raises:
            InputError: the port is out of its range, or a local server is bound to another address.
        """
        if port:
            require_range("port", port, low=1024, high=65000)
        if not lan and not ipaddress.ip_address(host).is_loopback:
            raise InputError(
                f"host: expected {LOCAL} without --lan, got {host}; add --lan to let others in"
            )
        self.host, self.port, self.lan, self._page = host, port, lan, page
        self._pages, self._roles = pages, roles
        self.key = key or secrets.token_urlsafe(9)
        self.token = token or secrets.token_urlsafe(16)
        self.clients: dict[int, Client] = {}
        self.refused: Counter[str] = Counter()  # requests that got nothing, by reason
        self._room, self._next = room, 1
        self._loop: asyncio.AbstractEventLoop | None = None
        self._thread = threading.Thread(target=self._run, name="classroom server", daemon=True)
        self._ready, self._problem = threading.Event(), ""
        self._stop: asyncio.Event | None = None
        self._gate = threading.BoundedSemaphore(4)  # bodies computed at once

    # From the session's thread
    # -------------------------

    def start(self) -> None:
        """Open the port; InputError where that fails."""
        self._thread.start()
        if not self._ready.wait(START_S) or self._problem:
            raise InputError(f"port {self.port}: {self._problem or 'the server does not start'}")

    def close(self) -> None:
        """Close all connections and the port."""
        loop, stop = self._loop, self._stop
        if loop is not None and stop is not None and loop.is_running():
            with suppress(RuntimeError):  # ended in between
                loop.call_soon_threadsafe(stop.set)
        self._thread.join(START_S)

    @property
    def address(self) -> str:
        """Host and port as a browser names them."""
        host = f"[{self.host}]" if ":" in self.host else self.host
        return f"{host}:{self.port}"

    def url(self, path: str = "/", **query: str) -> str:
        """Address of a page, with the token where it is needed."""
        if self.lan:
            query["token"] = self.token
        text = "&".join(f"{name}={value}" for name, value in query.items())
        return f"http://{self.address}{path}" + (f"?{text}" if text else "")

    def send_state(self, data: bytes) -> None:
        """Send a state to all; a client that is behind misses it."""
        self._post(self._broadcast, data, STATE_BUFFER, lambda client: True)

    def send_picture(self, data: bytes) -> None:
        """Send a picture to those who asked; a client that is behind misses it."""
        self._post(self._broadcast, data, PICTURE_BUFFER, lambda client: client.pictures)

    def send_text(self, text: str, role: str = "", client: int = 0) -> None:
        """Send a text to all, to those of a role, or to one client."""
        self._post(self._send_text, text, role, client)

    def wants_pictures(self) -> bool:
        """Whether any client asked for pictures."""
        return any(client.pictures for client in list(self.clients.values()))

    def has_role(self, role: str) -> bool:
        """Whether any client of a role is connected."""
        return any(client.role == role for client in list(self.clients.values()))

    def _post(self, function: Callable[..., None], *arguments: Any) -> None:
        loop = self._loop
        if loop is not None:
            with suppress(RuntimeError):  # the server has ended
                loop.call_soon_threadsafe(function, *arguments)

    # In the server's thread
    # ----------------------

    def _run(self) -> None:
        try:
            asyncio.run(self._serve())
        except Exception as error:  # reported by `start`
            self._problem = str(error) or type(error).__name__
        finally:
            self._loop = None
            self._ready.set()

    async def _serve(self) -> None:
        self._stop = asyncio.Event()
        server = await self._listen()
        async with server:
            self.port = int(next(iter(server.sockets)).getsockname()[1])
            self._loop = asyncio.get_running_loop()
            self._ready.set()
            await self._stop.wait()
            self._loop = None

    async def _listen(self) -> SocketServer:
        quiet = logging.getLogger("falconwing.classroom")
        quiet.addHandler(logging.NullHandler())
        quiet.propagate = False
        ports = [self.port] if not self.port else [self.port + offset for offset in range(10)]
        for port in ports:
            try:
                return await serve(
                    self._talk, self.host, port, process_request=self._answer, compression=None,
                    open_timeout=OPEN_S, ping_interval=PING_S, ping_timeout=2.0 * PING_S,
                    close_timeout=CLOSE_S, max_size=MAX_MESSAGE, max_queue=16, server_header=None,
                    logger=quiet,
                )  # fmt: skip
            except OSError as error:
                problem = error
        raise InputError(f"cannot listen at {self.host}: {problem.strerror or problem}")

    async def _answer(self, socket: ServerConnection, request: Request) -> Response | None:
        """The answer to a request; None lets a WebSocket begin. Whatever fails is a 403 or 404."""
        try:
            return await self._judge(socket, request)
        except Exception:
            self.refused["error"] += 1
            return _response(HTTPStatus.NOT_FOUND)

    async def _judge(self, socket: ServerConnection, request: Request) -> Response | None:
        parts = urlsplit(request.path)
        query = {name: values[0] for name, values in parse_qs(parts.query).items()}
        why = self._refusal(request.headers, query, is_socket=parts.path == "/ws")
        role, key = query.get("role", ""), query.get("key", "")
        if not why and (parts.path == "/desk" or role == "desk") and not self._is_key(key):
            why = "wrong key"
        if not why and parts.path == "/ws":
            why = self._refuse_client(role, _address(socket))
        if why:
            self.refused[why] += 1
            busy = why == "full"
            return _response(HTTPStatus.SERVICE_UNAVAILABLE if busy else HTTPStatus.FORBIDDEN)
        if parts.path == "/ws":
            return None
        response = await self._file(parts.path)
        if self.lan and "token" in query:
            value = f"{COOKIE}={self.token}; HttpOnly; SameSite=Strict; Path=/"
            response.headers["Set-Cookie"] = value
        return response

    def _refusal(self, headers: Headers, query: dict[str, str], *, is_socket: bool) -> str:
        """Why a request gets nothing; empty where it is allowed."""
        if headers.get_all("Host") != [self.address] and not self._is_local_name(headers):
            return "host"
        origins = headers.get_all("Origin")
        if (origins or is_socket) and origins != [f"http://{headers['Host']}"]:
            return "origin"
        if self.lan and not self._has_token(headers, query):
            return "token"
        return ""

    def _is_local_name(self, headers: Headers) -> bool:
        return not self.lan and headers.get_all("Host") == [f"localhost:{self.port}"]

    def _has_token(self, headers: Headers, query: dict[str, str]) -> bool:
        given = [query["token"]] if "token" in query else []
        with suppress(CookieError):
            for text in headers.get_all("Cookie"):
                cookies = SimpleCookie(text)
                given += [cookies[COOKIE].value] if COOKIE in cookies else []
        return any(_same(value, self.token) for value in given)

    def _is_key(self, key: str) -> bool:
        return _same(key, self.key)

    def _refuse_client(self, role: str, address: str) -> str:
        if role not in self._roles:
            return "role"
        per_address = MAX_PER_ADDRESS if self.lan else LOCAL_PER_ADDRESS
        same = sum(client.address == address for client in self.clients.values())
        # The teacher's page always finds a place.
        if role != "desk" and (len(self.clients) >= MAX_CLIENTS or same >= per_address):
            return "full"
        return ""

    async def _file(self, path: str) -> Response:
        if path in self._pages or path.startswith("/page/"):
            name = self._pages.get(path) or path.removeprefix("/page/")
            file = self._page / name
            if "/" in name or name.startswith(".") or not file.is_file():
                return _response(HTTPStatus.NOT_FOUND)
            return self._found(Body(file.read_bytes(), file.suffix))
        compute = self._room.body(path)
        if compute is None:
            return _response(HTTPStatus.NOT_FOUND)
        body = await asyncio.to_thread(self._limited, compute)
        return _response(HTTPStatus.NOT_FOUND) if body is None else self._found(body)

    def _limited(self, compute: Callable[[], Body | None]) -> Body | None:
        with self._gate:
            return compute()

    def _found(self, body: Body) -> Response:
        kind = TYPES.get(body.kind) or mimetypes.types_map.get(body.kind, "text/plain")
        headers = {"Content-Type": kind, "Cache-Control": "no-cache"}
        headers |= {"Content-Encoding": "gzip"} if body.is_gzip else {}
        if body.download:
            headers["Content-Disposition"] = f'attachment; filename="{body.download}"'
        headers["Content-Security-Policy"] = POLICY.format(sockets=f"ws://{self.address}")
        return _response(HTTPStatus.OK, body.data, headers)

    async def _talk(self, socket: ServerConnection) -> None:
        """Serve a WebSocket until it closes."""
        query = parse_qs(urlsplit(socket.request.path if socket.request else "").query)
        role, address = query["role"][0], _address(socket)
        if self._refuse_client(role, address):  # others came in since the handshake
            await socket.close(1013, "the class is full")
            return
        # A small buffer in the system, so that a page that sleeps does not wake up to old states.
        with suppress(OSError, AttributeError):
            raw = socket.transport.get_extra_info("socket")
            raw.setsockopt(SOL_SOCKET, SO_SNDBUF, SYSTEM_BUFFER)
        client = Client(self._next, role, address, socket)
        self._next += 1
        self.clients[client.number] = client
        try:
            self._room.joined(client)
            for text in self._room.hello(client):
                broadcast([socket], text)
            async for message in socket:
                if not self._hear(client, message):
                    await socket.close(1008, "too many messages")
                    return
        except ConnectionClosed:
            pass
        finally:
            self.clients.pop(client.number, None)
            self._room.left(client)

    def _hear(self, client: Client, message: str | bytes) -> bool:
        """Pass a message on; False where the client floods."""
        now = time.monotonic()
        second, count = client.second
        client.second = (int(now), count + 1 if second == int(now) else 1)
        if client.second[1] > FLOOD:
            return False
        if isinstance(message, bytes):
            sticks = unpack_sticks(message)
            if sticks is None:
                client.counts["malformed"] += 1
            elif self._spend(client, "sticks", STICKS_RATE, now):
                self._room.sticks(client, sticks)
            return True
        if not self._spend(client, "text", TEXT_RATE, now):
            return True
        text = read_text(message)
        if text is None:
            client.counts["malformed"] += 1
        elif text["type"] == "ping":
            stamp = text.get("stamp")
            is_number = isinstance(stamp, (int, float)) and math.isfinite(stamp)
            broadcast([client.socket], write_text("pong", stamp=stamp if is_number else None))
        elif text["type"] == "picture":
            client.pictures = text.get("on") is True
        elif text["type"] == "ready":
            client.ready = True
        else:
            self._room.text_from(client, text)
        return True

    def _spend(self, client: Client, what: str, rate: float, now: float) -> bool:
        """Whether a message is within the rate: a token bucket that holds half a second of it."""
        tokens, last = client.allowances.get(what, (rate / 2.0, now))
        tokens = min(tokens + (now - last) * rate, rate / 2.0)
        allowed = tokens >= 1.0
        client.allowances[what] = (tokens - 1.0 if allowed else tokens, now)
        if not allowed:
            client.counts[f"too many {what}"] += 1
        return allowed

    def _broadcast(self, data: bytes, waiting: int, chosen: Callable[[Client], bool]) -> None:
        """Send to the chosen clients in whose connection at most so many bytes wait."""
        broadcast(
            [
                client.socket
                for client in self.clients.values()
                if chosen(client) and _waiting(client.socket) <= waiting
            ],
            data,
        )

    def _send_text(self, text: str, role: str, number: int) -> None:
        for client in list(self.clients.values()):
            if (role and client.role != role) or (number and client.number != number):
                continue
            if _waiting(client.socket) > TEXT_BUFFER:
                client.socket.transport.abort()  # it does not read; its page connects again
            else:
                broadcast([client.socket], text)


def _response(
    status: HTTPStatus, body: bytes = b"", headers: dict[str, str] | None = None
) -> Response:
    fields = Headers(headers or {})
    fields["Content-Length"] = str(len(body))
    fields["Connection"] = "close"
    fields["X-Content-Type-Options"] = "nosniff"
    fields["Referrer-Policy"] = "no-referrer"
    fields["Cross-Origin-Resource-Policy"] = "same-origin"
    return Response(status.value, status.phrase, fields, body)


def _waiting(socket: ServerConnection) -> int:
    """Bytes that wait in a connection's buffer here, beyond those that the system holds."""
    return int(socket.transport.get_write_buffer_size())


def _address(socket: ServerConnection) -> str:
    return str(socket.remote_address[0]) if socket.remote_address else ""


def _same(given: str, expected: str) -> bool:
    """Whether two secrets agree, in constant time."""
    return hmac.compare_digest(given.encode(), expected.encode())
