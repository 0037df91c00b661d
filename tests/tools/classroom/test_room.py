"""The room: names, the queue for the sticks, the teacher's rights, and what a newcomer is sent."""

import itertools
import json
from types import SimpleNamespace

import pytest

from falconwing_kit.tools.classroom.channel import SticksMessage, read_text
from falconwing_kit.tools.classroom.hands import Hands
from falconwing_kit.tools.classroom.room import TEACHERS, Room
from falconwing_kit.tools.classroom.server import Client


class Server:
    """What a room uses of a server; keeps what is sent."""

    def __init__(self):
        self.clients, self.sent = {}, []

    def send_text(self, text, role="", client=0):
        self.sent.append((json.loads(text), role, client))

    def has_role(self, role):
        return any(client.role == role for client in self.clients.values())

    def wants_pictures(self):
        return False

    def url(self, path):
        return f"http://127.0.0.1:8080{path}"


@pytest.fixture
def room(tmp_path):
    """A room without a flight; requests to the session are noted."""
    room = Room(Hands(clock=lambda: 0.0), lambda: None, "arena", lambda: b"scene", tmp_path)
    room.server = Server()
    room.asked = []
    room.session = SimpleNamespace(
        request=lambda what, value=None: room.asked.append((what, value)), task=None
    )
    yield room
    room.close()


def join(room, role="seat"):
    """A new client of the room."""
    number = len(room.server.clients) + 1
    client = room.server.clients[number] = Client(number, role, "127.0.0.1", None)
    room.joined(client)
    return client


def ask(room, page, kind="ask", **fields):
    """A message of a client."""
    room.text_from(page, {"type": kind, **fields})


def test_without_a_teacher_the_first_who_asks_flies_and_the_next_waits(room):
    """And follows as soon as the first has gone or gives the turn back."""
    mia, tom = join(room), join(room)
    ask(room, mia, "name", name="Mia\n<b>" + 40 * "x")
    ask(room, mia), ask(room, tom), ask(room, tom)
    assert room.hands.owner == mia.number and room.queue == [tom.number]
    who = [text for text, *_ in room.server.sent if text["type"] == "who"][-1]
    assert who["owner_may"] == 1 and who["queue"] == [{"client": 2, "name": "Seat 2"}]
    assert room.names[1] == ("Mia<b>" + 40 * "x")[:24]
    room.left(mia)
    assert room.hands.owner == 0
    room.finished(record("Tom"))
    assert room.hands.owner == tom.number and room.queue == []


def test_with_a_teacher_only_the_teacher_gives(room):
    """A seat's teacher messages are counted and ignored."""
    mia, desk = join(room), join(room, "desk")
    ask(room, mia)
    assert room.hands.owner == 0 and room.queue == [1]
    for kind in ("give", "pause", "end", "effect", "take"):
        ask(room, mia, kind, client=1, on=True, name="wind")
    assert room.hands.owner == 0 and room.asked == [] and mia.counts["not understood"] == 5
    ask(room, desk, "give", client=1)
    assert room.hands.owner == 1 and room.queue == []
    ask(room, desk, "take")
    assert room.hands.owner == 0


@pytest.mark.parametrize(
    ("message", "request_"),
    [
        ({"type": "pause", "on": True}, ("pause", True)),
        ({"type": "speed", "value": 0.25}, ("speed", 0.25)),
        ({"type": "effect", "name": "wind", "on": True}, ("effect", ("wind", True))),
        ({"type": "task", "task": "follow"}, ("task", ("follow", ""))),
        ({"type": "restart"}, ("restart", None)),
        ({"type": "speed", "value": float("nan")}, None),
        ({"type": "speed", "value": "fast"}, None),
        ({"type": "give", "client": [1]}, None),
        ({"type": "effect", "name": 3}, None),
        ({"type": "nonsense"}, None),
    ],
)
def test_the_teachers_messages_reach_the_session(room, message, request_):
    """Wrong fields are counted, never an exception."""
    desk = join(room, "desk")
    room.text_from(desk, message)
    assert room.asked == ([request_] if request_ else [])
    assert desk.counts["not understood"] == (0 if request_ else 1)


def test_a_take_back_ends_the_wait_for_the_next_step(room):
    """Only where a student flew: taken, or given to somebody else."""
    mia, tom, desk = join(room), join(room), join(room, "desk")
    ask(room, desk, "take")
    for kind, client in (("give", tom.number), ("take", 0)):
        room.asked.clear()
        ask(room, desk, "give", client=mia.number)
        for k in range(7):
            room.sticks(mia, SticksMessage(k > 0, False, k, 0, 0.5, 0.0, 0.0, 0.0))
        assert room.hands.holder == "student" and room.asked == []
        ask(room, desk, kind, client=client)
        assert room.hands.holder == "autopilot" and room.asked == [("step", None)]


AWKWARD = (
    "null", "true", "-1", "1e999", "9" * 400, "1.5", '"\\ud800"', '"' + 300 * "x" + '"', "[]",
    "[1]", "{}", '{"a":[1]}', "NaN", '"\\u0000\\n"',
)  # fmt: skip
KINDS = ("name", "ask", "leave", "assist", "gap", *TEACHERS, "__class__", "")


def test_awkward_messages_of_seat_and_desk_raise_nothing(room):
    """Every kind of message with every awkward value in all its fields: dropped or answered."""
    pages = (join(room), join(room, "desk"))
    fields = ("name", "client", "on", "value", "flight", "task", "manoeuvre")
    heard = 0
    for page, kind, value in itertools.product(pages, KINDS, AWKWARD):
        body = ",".join(f'"{field}":{value}' for field in fields)
        message = read_text(f'{{"type":{json.dumps(kind)},{body}}}')
        if message is not None:
            heard += 1
            room.text_from(page, message)
    assert heard > 300


def test_sticks_without_leave_are_reported_once(room):
    """The session logs it once for each client, whatever follows."""
    tom = join(room)
    for k in range(100):
        room.sticks(tom, SticksMessage(True, False, k, 0, 0.5, 0.0, 0.0, 0.0))
    assert room.asked == [("ignored", "Seat 1")] and room.hands.holder == "autopilot"


def test_a_newcomer_gets_the_hall_and_what_happened(room):
    """The pad and hall of the kit, all effects, the newest flight and events."""
    room.text("flight", number=3, task="landing")
    room.text("event", t=1.0, flight=3, name="effect", text="Drag.")
    texts = [json.loads(text) for text in room.hello(join(room))]
    hello = texts[0]
    assert hello["pad"] == {"x0": 1.0, "x1": 14.0, "y0": -3.0, "y1": -1.0, "z": 0.1}
    assert hello["hall"] == {"x": [-22.5, 17.5], "y": [-12.0, 8.0], "z": [0.0, 5.0]}
    assert hello["scene_bytes"] == 5 and hello["stick_timeout_ms"] == 200
    assert {"name", "physics"} == set(hello["effects"][0]) and len(hello["effects"]) > 15
    assert [text["type"] for text in texts[1:]] == ["flight", "event", "who"]
    assert room.body("/flights/9.json") is None and room.body("/flights/../x.json") is None
    assert room.body("/scene.bin")().data == b"scene"
    assert b"<svg" in room.body("/qr.svg")().data


def record(name):
    """A flight that this person flew, without a log."""
    return SimpleNamespace(number=1, holders=(name,), log=None)
