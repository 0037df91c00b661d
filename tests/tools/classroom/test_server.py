"""The server against raw clients: no token no byte, foreign hosts, floods, half messages."""

import http.client
import json
import socket
import threading
import time
from contextlib import ExitStack, contextmanager

import pytest
from websockets.exceptions import InvalidStatus
from websockets.sync.client import connect

from falconwing_kit.core.checks import InputError
from falconwing_kit.core.messages import Command
from falconwing_kit.tools.classroom import server as module
from falconwing_kit.tools.classroom.channel import pack_sticks
from falconwing_kit.tools.classroom.server import MAX_CLIENTS, Body, Server

PATIENCE_S = 10.0  # for anything to arrive


class Recorder:
    """A class that notes what the server passes on."""

    def __init__(self):
        self.sticks_seen, self.texts, self.gone = [], [], []

    def hello(self, client):
        return [json.dumps({"type": "hello", "client": client.number})]

    def joined(self, client):
        pass

    def left(self, client):
        self.gone.append(client.number)

    def sticks(self, client, sticks):
        self.sticks_seen.append((client.number, sticks))

    def text_from(self, client, message):
        self.texts.append(message)

    def body(self, path):
        return (lambda: Body(b"data", ".json")) if path == "/flights.json" else None


@contextmanager
def running(tmp_path, **how):
    """A server with one page, and its class."""
    (tmp_path / "seat.html").write_text("<!doctype html>seat")
    (tmp_path / "desk.html").write_text("desk")
    (tmp_path / "seat.js").write_text("// seat")
    room = Recorder()
    server = Server(room, port=0, page=tmp_path, **how)
    server.start()
    try:
        yield server, room
    finally:
        server.close()


def get(server, path, **headers):
    """Status, body and headers of a request."""
    connection = http.client.HTTPConnection(server.host, server.port, timeout=PATIENCE_S)
    connection.putrequest("GET", path, skip_host=True, skip_accept_encoding=True)
    for name, value in ({"Host": server.address} | headers).items():
        connection.putheader(name, value)
    connection.endheaders()
    answer = connection.getresponse()
    body = answer.read()
    connection.close()
    return answer.status, body, answer


def page(server, role="seat", origin=None, headers=None, **query):
    """A WebSocket of a page."""
    text = "&".join(f"{name}={value}" for name, value in {"role": role, **query}.items())
    return connect(
        f"ws://{server.address}/ws?{text}", origin=origin or f"http://{server.address}",
        additional_headers=headers, open_timeout=PATIENCE_S, compression=None,
    )  # fmt: skip


def wait_for(condition):
    """Wait until a condition holds; False where it does not in time."""
    end = time.monotonic() + PATIENCE_S
    while not condition() and time.monotonic() < end:
        time.sleep(0.01)
    return condition()


def test_pages_come_with_a_policy_and_nothing_else_does(tmp_path):
    """The type, the content security policy and nosniff; no folder above and no hidden file."""
    (tmp_path / ".secret").write_text("secret")
    with running(tmp_path) as (server, _):
        status, body, answer = get(server, "/")
        assert (status, body) == (200, b"<!doctype html>seat")
        assert answer.getheader("Content-Type") == "text/html; charset=utf-8"
        assert "default-src 'none'" in answer.getheader("Content-Security-Policy")
        assert answer.getheader("X-Content-Type-Options") == "nosniff"
        assert get(server, "/page/seat.js")[:2] == (200, b"// seat")
        assert get(server, "/flights.json")[:2] == (200, b"data")
        for path in ("/page/../seat.html", "/page/.secret", "/page/%2e%2e/x", "/x", "/page/"):
            assert get(server, path)[:2] == (404, b"")


def test_without_the_token_no_byte(tmp_path):
    """On a network: none, a wrong one, or one in a wrong cookie; the right one sets the cookie."""
    with running(tmp_path, lan=True) as (server, _):
        for path, headers in (
            ("/", {}), ("/?token=wrong", {}), ("/flights.json", {}), ("/page/seat.js", {}),
            ("/", {"Cookie": "falconwing_token=wrong"}), ("/", {"Cookie": "token=;;=x"}),
            ("/ws?role=seat", {"Upgrade": "websocket"}),
        ):  # fmt: skip
            assert get(server, path, **headers)[:2] == (403, b""), path
        status, _, answer = get(server, f"/?token={server.token}")
        cookie = answer.getheader("Set-Cookie")
        assert status == 200 and "HttpOnly" in cookie and "SameSite=Strict" in cookie
        assert get(server, "/", Cookie=cookie.split(";")[0])[0] == 200
        with pytest.raises(InvalidStatus) as refused:
            page(server)
        assert refused.value.response.status_code == 403 and not refused.value.response.body
        with page(server, headers={"Cookie": cookie.split(";")[0]}) as socket_:
            assert json.loads(socket_.recv(PATIENCE_S))["type"] == "hello"
        with page(server, token=server.token) as socket_:
            assert json.loads(socket_.recv(PATIENCE_S))["type"] == "hello"
        assert len(server.token) >= 22  # 128 bits in base 64


def test_foreign_hosts_and_origins_get_nothing(tmp_path):
    """A name that leads to this address (DNS rebinding), and a page of another site."""
    with running(tmp_path) as (server, _):
        assert get(server, "/", Host="evil.example")[:2] == (403, b"")
        assert get(server, "/", Host=f"evil.example:{server.port}")[:2] == (403, b"")
        assert get(server, "/", Origin="http://evil.example")[:2] == (403, b"")
        assert get(server, "/", Host=f"localhost:{server.port}")[0] == 200
        for origin in ("http://evil.example", f"https://{server.address}", "null"):
            with pytest.raises(InvalidStatus):
                page(server, origin=origin)
        with pytest.raises(InvalidStatus):  # a page always names its origin
            connect(f"ws://{server.address}/ws?role=seat", open_timeout=PATIENCE_S)
        assert server.refused["origin"] == 5 and server.refused["host"] == 2
    with running(tmp_path, lan=True) as (server, _):  # this machine's short name is not the class's
        short = f"localhost:{server.port}"
        assert get(server, f"/?token={server.token}", Host=short)[:2] == (403, b"")


def test_the_desk_needs_its_key(tmp_path):
    """Page and socket; a role that is none is refused too."""
    with running(tmp_path) as (server, _):
        assert get(server, "/desk")[:2] == (403, b"")
        assert get(server, "/desk?key=wrong")[:2] == (403, b"")
        assert get(server, f"/desk?key={server.key}")[0] == 200
        for query in ({"role": "desk"}, {"role": "desk", "key": "%C3%A4"}, {"role": "pilot"}):
            with pytest.raises(InvalidStatus):
                page(server, **query)
        with page(server, role="desk", key=server.key) as desk:
            assert json.loads(desk.recv(PATIENCE_S))["type"] == "hello"


def test_floods_and_half_messages_are_dropped_and_counted(tmp_path):
    """600 sticks at once: the bucket of 60 passes on, not the others; a pilot beside flies on."""
    with running(tmp_path) as (server, room), page(server) as flood, page(server) as pilot:
        flood.recv(PATIENCE_S), pilot.recv(PATIENCE_S)
        for k in range(600):
            flood.send(pack_sticks(k, Command(0.5, 0.0, 0.0, 0.0)))
        for text in ("{", "[]", '{"type":3}', '{"type":"ping","stamp":%s}' % (400 * "9")):
            flood.send(text)
        flood.send(b"\x03half")
        flood.send('{"type":"name","name":"Mia"}')
        pilot.send(pack_sticks(1, Command(0.5, 0.0, 0.0, 0.0)))
        assert wait_for(lambda: room.texts and any(n == 2 for n, _ in room.sticks_seen))
        passed = sum(number == 1 for number, _ in room.sticks_seen)
        client = server.clients[1]
        assert 55 <= passed <= 400 and client.counts["too many sticks"] == 600 - passed
        assert client.counts["malformed"] == 4


def test_a_larger_flood_is_disconnected_and_a_long_message_too(tmp_path):
    """The limits of a second and of a message; the server answers others all the while."""
    with running(tmp_path) as (server, room):
        with page(server) as flood, pytest.raises(Exception) as ended:
            for k in range(20_000):
                flood.send(pack_sticks(k, Command(0.5, 0.0, 0.0, 0.0)))
                if k % 500 == 0:
                    flood.ping().wait(PATIENCE_S)
        assert "1008" in str(ended.value) or "close" in str(ended.value).lower()
        with page(server) as long:
            long.send(b"x" * (module.MAX_MESSAGE + 1))
            assert wait_for(lambda: len(room.gone) == 2)
        assert get(server, "/")[0] == 200


def test_200_clients_find_60_places(tmp_path):
    """The others get 503; places are free again when someone goes; the teacher always finds one."""
    with running(tmp_path) as (server, _), ExitStack() as stack:
        refused = 0
        for _ in range(200):
            try:
                stack.enter_context(page(server))
            except InvalidStatus as error:
                assert error.response.status_code == 503
                refused += 1
        assert refused == 200 - MAX_CLIENTS
        with page(server, role="desk", key=server.key) as desk:
            assert json.loads(desk.recv(PATIENCE_S))["type"] == "hello"
        stack.close()
        assert wait_for(lambda: not server.clients)
        with page(server):
            pass


def test_open_connections_that_say_nothing_do_not_stop_others(tmp_path):
    """Half a request, and none at all, 50 times each."""
    with running(tmp_path) as (server, _):
        silent = []
        for k in range(100):
            connection = socket.create_connection((server.host, server.port), PATIENCE_S)
            connection.sendall(b"GET / HTTP/1.1\r\nHost" if k % 2 else b"")
            silent.append(connection)
        assert get(server, "/")[0] == 200
        for connection in silent:
            connection.close()


def test_a_page_that_does_not_read_misses_states_and_blocks_no_one(tmp_path):
    """Ten seconds of states at 20 Hz, sent as fast as it goes: the one who reads has the last."""
    with running(tmp_path) as (server, _), page(server) as reader:
        sleeper = socket.create_connection((server.host, server.port), PATIENCE_S)
        sleeper.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 2048)
        sleeper.sendall(
            f"GET /ws?role=seat HTTP/1.1\r\nHost: {server.address}\r\nUpgrade: websocket\r\n"
            f"Connection: Upgrade\r\nSec-WebSocket-Key: AAAAAAAAAAAAAAAAAAAAAA==\r\n"
            f"Sec-WebSocket-Version: 13\r\nOrigin: http://{server.address}\r\n\r\n".encode()
        )
        assert wait_for(lambda: len(server.clients) == 2)
        newest = []

        def read():
            for message in reader:
                newest.append(message)

        thread = threading.Thread(target=read, daemon=True)
        thread.start()
        for k in range(5000):
            server.send_state(b"\x01" + k.to_bytes(4, "little") + bytes(1000))
            if k % 50 == 0:
                time.sleep(0.002)
        last = b"\x01" + (5000).to_bytes(4, "little") + bytes(1000)

        def seen():
            server.send_state(last)
            return newest and newest[-1] == last

        assert wait_for(seen)
        sockets = [client.socket for client in list(server.clients.values())]
        assert all(module._waiting(one) < 16 * 1024 for one in sockets)
        sleeper.close()


def test_only_this_machine_without_lan(tmp_path):
    """An address of the network needs --lan; a port in use moves to the next."""
    with pytest.raises(InputError, match="--lan"):
        Server(Recorder(), host="192.0.2.1")
    with pytest.raises(InputError, match="port"):
        Server(Recorder(), port=80)
    with socket.socket() as busy:
        busy.bind(("127.0.0.1", 0))
        busy.listen()
        taken = busy.getsockname()[1]
        if not 1024 <= taken <= 64990:
            pytest.skip("the system gave a port out of range")
        server = Server(Recorder(), port=taken, page=tmp_path)
        server.start()
        try:
            assert taken < server.port < taken + 10
        finally:
            server.close()
