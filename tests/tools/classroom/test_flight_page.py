"""The flight page against raw clients: how long a flight waits for a browser."""

import json
import socket
import threading
import time

import pytest
from websockets.sync.client import connect

from falconwing_kit.tools.classroom import flight_page as module
from falconwing_kit.tools.classroom.flight_page import FlightPage

PATIENCE_S = 10.0


@pytest.fixture
def page():
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = int(probe.getsockname()[1])
    with FlightPage(port=port) as served:
        yield served


def browser(page):
    """A connection as the page in a browser makes it."""
    address = page.url.removeprefix("http://").rstrip("/")
    return connect(f"ws://{address}/ws?role=wall", origin=f"http://{address}", compression=None)


def waiting(page):
    """A thread that waits for the page's viewer, and what it is told."""
    told = []
    thread = threading.Thread(target=lambda: told.append(page.wait_for_viewer(PATIENCE_S)))
    thread.start()
    return thread, told


def test_nobody_looks_on(page):
    begin = time.monotonic()
    assert page.wait_for_viewer(0.2) is False
    assert time.monotonic() - begin >= 0.2


def test_a_flight_waits_for_the_hall_on_the_screen(page):
    """Connected alone is not enough; the page's word is, at once."""
    with browser(page) as client:
        assert json.loads(client.recv(PATIENCE_S))["type"] == "hello"
        thread, told = waiting(page)
        thread.join(0.5)
        assert thread.is_alive()
        client.send('{"type": "ready"}')
        thread.join(PATIENCE_S)
        assert told == [True]


def test_a_page_that_never_draws_the_hall_is_waited_for_no_longer(page, monkeypatch):
    monkeypatch.setattr(module, "HALL_S", 0.1)
    with browser(page) as client:
        client.recv(PATIENCE_S)
        assert page.wait_for_viewer(0.1) is True
