"""The live page without a browser: who can reach it, that a flight never waits for it, and where
things are drawn.
"""

import re
import socket
import threading
import urllib.request
import warnings
from concurrent.futures import wait
from dataclasses import replace
from types import SimpleNamespace

import msgspec
import numpy as np
import pytest
import viser
from viser._messages import ShareUrlRequest
from websockets.sync.client import connect
from websockets.typing import Subprotocol

from falconwing_kit.core.checks import InputError
from falconwing_kit.core.messages import Command, State
from falconwing_kit.flight.loop import LoopStep
from falconwing_kit.scene.gaussians import GaussianScene
from falconwing_kit.scene.ply import SH_C0
from falconwing_kit.tools.demo.live_page import (
    WINDOW_S,
    LivePage,
    hall_sides,
    head_html,
    plots_html,
)

RED = np.array([0.9, 0.1, 0.1])


def dots(*places: tuple[float, float, float]) -> GaussianScene:
    """Red balls of 5 cm."""
    n = len(places)
    return GaussianScene(
        np.array(places),
        np.tile([1.0, 0.0, 0.0, 0.0], (n, 1)),
        np.full((n, 3), 0.05),
        np.full(n, 0.99),
        np.tile((RED - 0.5) / SH_C0, (n, 1, 1)),
    )


def step(t: float, mode: str = "approach") -> LoopStep:
    """A step that flies straight on."""
    state = State(np.array([t, -2.0, 1.0]), 0.0, 0.0, 0.0, np.array([1.0, 0.0, 0.0]))
    return LoopStep(t, None, state, Command(0.5, 0.0, 0.0, 0.0), mode, None)


def free_port() -> int:
    """A port that nobody listens to."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


@pytest.fixture
def page():
    """An empty page."""
    with LivePage(port=free_port()) as page:
        yield page


def test_page_is_served_to_this_machine_only(page):
    """Bound to 127.0.0.1 alone, so that even another address of the loopback is refused."""
    assert urllib.request.urlopen(page.url, timeout=30).read(15).lower() == b"<!doctype html>"
    with pytest.raises(ConnectionRefusedError):
        socket.create_connection(("127.0.0.2", page.port), timeout=5)


def test_no_tunnel_to_the_outside_can_be_opened(page, monkeypatch):
    """A browser can ask the server for a share link without the button, by the very message; no
    tunnel begins then.
    """
    tunnels, jobs, asked = [], [], threading.Event()
    pool = page._server._thread_executor
    submit = pool.submit
    monkeypatch.setattr(
        "viser._viser.ViserTunnel", lambda *where: tunnels.append(where) or pytest.fail("a tunnel")
    )
    monkeypatch.setattr(pool, "submit", lambda *job: jobs.append(submit(*job)) or jobs[-1])
    # Handlers are called in the order in which they came: after this one the server's own has been
    # called.
    page._server._websock_server.register_handler(ShareUrlRequest, lambda *_: asked.set())
    protocol = Subprotocol(f"viser-v{viser.__version__}")
    with connect(page.url.replace("http", "ws"), subprotocols=[protocol], max_size=None) as browser:
        browser.send(msgspec.msgpack.encode(ShareUrlRequest().as_serializable_dict()))
        assert asked.wait(60.0)
        assert len(wait(jobs, 60.0).done) == len(jobs) > 0
    assert tunnels == []


def test_occupied_port_is_said_and_the_next_one_taken():
    """Another program listens already; the page is at a later port and the warning names it."""
    with socket.socket() as other:
        other.bind(("127.0.0.1", 0))
        other.listen()
        taken = other.getsockname()[1]
        with (
            pytest.warns(UserWarning, match=f"port {taken} is taken") as said,
            LivePage(port=taken) as page,
        ):
            assert page.port > taken
            assert page.url in str(said[0].message)
            assert urllib.request.urlopen(page.url, timeout=30).status == 200


@pytest.mark.parametrize("port", [0, 80, 70_000])
def test_port_out_of_range_is_one_sentence(port):
    """Ports below 1024 belong to the system, above 65535 there are none."""
    with pytest.raises(InputError, match="port: expected a finite number in"):
        LivePage(port=port)


def test_closed_page_gives_its_port_back():
    """Nobody answers there any more, and a second page can have the same port without a warning."""
    port = free_port()
    LivePage(port=port).close()
    with pytest.raises(ConnectionRefusedError):
        socket.create_connection(("127.0.0.1", port), timeout=5)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        LivePage(port=port).close()


def test_flight_never_waits_and_the_newest_step_is_drawn(page, monkeypatch):
    """While one drawing hangs a thousand steps are shown; then the last of them is drawn and those
    between are not.
    """
    drawn, begun, go_on = [], threading.Event(), threading.Event()

    def draw(step, past, plots):
        drawn.append((step.t, len(past)))
        begun.set()
        assert go_on.wait(60.0)

    monkeypatch.setattr(page, "_draw", draw)
    page.show(step(0.0))
    assert begun.wait(60.0)
    for k in range(1, 1000):
        page.show(step(0.05 * k))
    go_on.set()
    page.close()
    assert drawn == [(0.0, 1), (0.05 * 999, 1000)]


def test_fault_ends_the_page_and_not_the_flight(page, monkeypatch):
    """The drawing thread warns why it stopped; the flight continues and may call `show`."""
    said = threading.Event()
    monkeypatch.setattr(page, "_draw", lambda *_, **__: 1 / 0)
    monkeypatch.setattr(
        warnings, "warn", lambda text, **_: said.set() if "the flight continues" in text else None
    )
    page.show(step(0.0))
    assert said.wait(60.0)
    page.show(step(0.05))


def test_unknown_pose_hides_the_aircraft_and_the_page_lives_on(page, monkeypatch):
    """A log may say null of a state: hidden while it does, there again after; the path has the
    known places only.
    """
    known, drawn, draw = step(0.0), threading.Event(), page._draw
    seen = []

    def look(step, past, plots):
        draw(step, past, True)
        seen.append((page._aircraft.visible, page._leader.visible, len(past)))
        drawn.set()

    monkeypatch.setattr(page, "_draw", look)
    lost = {"p_world": np.array([np.nan, -2.0, 1.0])}, {"yaw": np.nan}
    for k, part in enumerate(({}, *lost, {})):
        drawn.clear()
        state = replace(known.state, **part)
        page.show(replace(known, t=0.05 * k, state=state, leader=state))
        assert drawn.wait(60.0)
    assert seen == [(True, True, 1), (False, False, 1), (False, False, 1), (True, True, 2)]


def test_unknown_speed_is_left_out_of_its_plot(page, monkeypatch):
    """Poses alone, as of a tracker: the aircraft is shown. By hand: heights of all five steps,
    speeds of four.
    """
    past = []
    monkeypatch.setattr(page, "_draw", lambda step, rows, plots: past.append((step.state, rows)))
    for k in range(5):
        v_world = np.array([3.0 if k != 2 else np.nan, 0.0, 0.0])
        page.show(replace(step(0.05 * k), state=replace(step(0.0).state, v_world=v_world)))
    page.close()
    state, rows = past[-1]
    assert state is not None and len(rows) == 5
    lines = re.findall(r'points="([^"]+)"', plots_html(rows[:, [0, 3, 4]], None))
    assert [len(line.split()) for line in lines] == [5, 4] and "nan" not in "".join(lines)


def test_earlier_time_begins_a_new_flight(page, monkeypatch):
    """Three steps, and then the clock is back at zero: the path has one point."""
    lengths = []
    monkeypatch.setattr(page, "_draw", lambda step, past, plots: lengths.append(len(past)))
    for t in (0.0, 0.05, 0.10, 0.0):
        page.show(step(t))
    page.close()
    assert lengths[-1] == 1


def test_everything_of_a_step_reaches_the_page(page):
    """What the browser gets, read from the server's side: pose, view, words; then a step without
    state hides it.
    """
    pixels = np.zeros((24, 32, 3), np.uint8)
    pixels[:, 16:] = (200, 30, 30)
    shown = LoopStep(
        1.0,
        SimpleNamespace(pixels=pixels),
        step(1.0).state,
        Command(0.5, 0, 0, 0),
        "flare",
        step(9.0).state,
    )
    page._past.append((1.0, 1.0, -2.0, 1.0, 1.0))
    page._draw(shown, np.array(page._past), plots=True)
    assert page._aircraft.visible and page._leader.visible
    assert page._aircraft.position == pytest.approx([1.0, -2.0, 1.0])
    # Level along world x: the belly looks down, so the body's axes are half a turn about x away
    # from the world's.
    assert np.abs(page._aircraft.wxyz) == pytest.approx([0.0, 1.0, 0.0, 0.0], abs=1e-9)
    assert page._leader.position == pytest.approx([9.0, -2.0, 1.0])
    assert np.array_equal(page._view.image, pixels)
    assert "flare" in page._head.content and "SIMULATION" in page._head.content
    page._draw(
        LoopStep(1.05, None, None, Command(0, 0, 0, 0), "no state", None),
        np.array(page._past),
        plots=False,
    )
    assert not page._aircraft.visible and not page._leader.visible


def test_words_of_a_pilot_are_text_and_no_markup():
    """A mode may hold anything; what is flown stands first."""
    text = head_html("SIMULATION", step(2.0, mode="<b>&"))
    assert "&lt;b&gt;&amp;" in text and "<b>&" not in text
    assert text.index("SIMULATION") < text.index("&lt;b&gt;")
    assert "2.0 s" in text and "height 1.00 m" in text


@pytest.mark.parametrize(
    ("command", "left", "right"),
    [
        (Command(0.5, 0.0, 0.0, 0.0), (0, 0), (0, 0)),
        (Command(1.0, 0.0, 0.0, 0.0), (0, -1), (0, 0)),
        (Command(0.5, 1.0, 0.0, 0.0), (0, 0), (1, 0)),
        (Command(0.5, 0.0, 1.0, 0.0), (0, 0), (0, 1)),
        (Command(0.5, 0.0, 0.0, 1.0), (1, 0), (0, 0)),
    ],
)
def test_sticks_stand_as_on_a_mode_2_transmitter(command, left, right):
    """Left: throttle forward is up, rudder right is right. Right: aileron right is right, nose up
    is back, so down.
    """
    text = plots_html(np.zeros((0, 3)), command)
    dots = [
        (float(x), float(y)) for x, y in re.findall(r'<circle cx="([\d.]+)" cy="([\d.]+)"', text)
    ]
    middle = [(95.0, 75.0), (275.0, 75.0)]
    away = [
        tuple(int(np.sign(a - b)) for a, b in zip(*pair, strict=True))
        for pair in zip(dots, middle, strict=True)
    ]
    assert away == [left, right]


def test_plots_look_back_half_a_minute_and_fit_their_frame():
    """A climb to 40 m over a minute: the line begins after 30 s and stays between the axes, 30..360
    and 16..92.
    """
    t = np.arange(0.0, 60.0, 0.05)
    lines = re.findall(
        r'points="([^"]+)"', plots_html(np.stack([t, t * 40.0 / 60.0, 0.0 * t + 7.0], axis=1), None)
    )
    height = np.array([[float(c) for c in pair.split(",")] for pair in lines[0].split()])
    assert len(height) <= 301
    assert height[:, 0].min() >= 29.9 and height[:, 0].max() <= 360.1
    assert height[:, 1].min() >= 15.9 and height[:, 1].max() <= 92.1
    # 40 m are the top line, 92 - 76 = 16; half a minute earlier the height was half of that.
    assert height[0, 1] == pytest.approx(92.0 - 76.0 * (60.0 - WINDOW_S) / 60.0, abs=0.5)


@pytest.mark.parametrize(
    "place",
    [
        (3.0, -5.0, 0.02),
        (17.45, -3.0, 1.0),
        (-22.45, 4.0, 2.0),
        (-9.0, 7.95, 3.0),
        (6.0, -11.95, 4.0),
    ],
)
def test_a_dot_on_a_side_is_where_it_is_in_the_world(place):
    """Floor and four walls: the red pixels, carried to the world by the picture's corners alone,
    are at the dot.

    A pixel is 2 cm. A mirrored or turned picture would be off by metres, for no dot is near a
    middle.
    """
    ((corners, rgb),) = hall_sides(dots(place))
    rows, columns = np.nonzero((rgb[..., 0] > 150) & (rgb[..., 1] < 100))
    right, down = (columns.mean() + 0.5) / rgb.shape[1], (rows.mean() + 0.5) / rgb.shape[0]
    seen = corners[0] + right * (corners[1] - corners[0]) + down * (corners[3] - corners[0])
    side = np.argmin(
        np.abs(corners[0] - corners[2])
    )  # the axis across the side: there the picture is flat
    assert np.delete(seen, side) == pytest.approx(np.delete(np.array(place), side), abs=0.03)
    assert seen[side] == pytest.approx(place[side], abs=0.06)


def test_sides_face_the_inside_and_the_ceiling_is_open():
    """Seen from inside the corners run clockwise: the normal of (right, down) points out of the
    hall, as one looks.
    """
    hall = dots(
        (0.0, 0.0, 0.0),
        (17.5, 0.0, 2.0),
        (-22.5, 0.0, 2.0),
        (0.0, 8.0, 2.0),
        (0.0, -12.0, 2.0),
        (0.0, 0.0, 5.0),
    )
    middle = np.array([-2.5, -2.0, 2.5])
    sides = [corners for corners, _ in hall_sides(hall)]
    assert len(sides) == 5
    for corners in sides:
        outward = np.cross(corners[1] - corners[0], corners[3] - corners[0])
        assert outward @ (corners.mean(axis=0) - middle) > 0.0
