"""The pages of demo and replay in a real browser: `falconwing demo` as it is typed, watched in
headless Chromium.

Needs Debian's `chromium` and Playwright. In CI both must be there: a missing one fails; elsewhere
it skips.
"""

import base64
import io
import os
import signal
import socket
import subprocess
import sys
import time
from contextlib import contextmanager
from pathlib import Path
from urllib.parse import urlsplit

import numpy as np
import pytest
from PIL import Image as Picture

from falconwing_kit.core.messages import Command, Image, State
from falconwing_kit.flight.loop import LoopStep
from falconwing_kit.scene import load_scene
from falconwing_kit.tools.classroom import flight_page
from falconwing_kit.tools.classroom.flight_page import FlightPage
from tests.chromium import headless_chromium

ROOT = Path(__file__).resolve().parents[2]
FLIGHTS = 3  # of four seconds each, to be watched on a busy machine
PATIENCE_S = 90.0  # for anything in the browser: software drawing on a busy machine is slow

pytestmark = pytest.mark.timeout(600)


@pytest.fixture(scope="module")
def browser():
    """Headless Chromium that draws in software, as a machine without a GPU does."""
    flags = ["--use-angle=swiftshader", "--enable-unsafe-swiftshader"]
    with headless_chromium(flags) as running:
        yield running


class Visit:
    """A page in the browser, with everything that it asked for and complained of."""

    def __init__(self, browser, url: str) -> None:
        self.page = browser.new_page(viewport={"width": 1280, "height": 720})
        self.asked, self.complaints = [], []
        self.page.on("request", lambda request: self.asked.append(request.url))
        self.page.on("websocket", lambda connection: self.asked.append(connection.url))
        self.page.on(
            "console",
            lambda said: self.complaints.append(said.text) if said.type == "error" else None,
        )
        self.page.on("pageerror", lambda error: self.complaints.append(str(error)))
        self.page.goto(url)

    def until(self, what) -> None:
        """Until something holds of the page; its own wait needs an eval that its policy forbids."""
        end = time.monotonic() + PATIENCE_S
        while not what(self.page):
            assert time.monotonic() < end, self.page.inner_text("body")
            time.sleep(0.05)

    def says(self, words: str) -> None:
        """Until the page shows these words."""
        self.until(lambda page: words in page.inner_text("body"))

    def look(self, selector: str) -> np.ndarray:
        """A part of the page (H, W, 3) as it stands on the screen."""
        box = self.page.locator(selector).bounding_box()
        taken = self.page.screenshot(clip=box, timeout=1000.0 * PATIENCE_S)
        screen = Picture.open(io.BytesIO(taken))
        return np.asarray(screen.convert("RGB")).astype(int)

    def picture(self, selector: str) -> np.ndarray:
        """A canvas (H, W, 3) as the page holds it now; a busy machine takes long to show it."""
        address = self.page.eval_on_selector(selector, "canvas => canvas.toDataURL()")
        held = Picture.open(io.BytesIO(base64.b64decode(address.split(",")[1])))
        return np.asarray(held.convert("RGB")).astype(int)

    def hosts(self) -> set[str]:
        """Every host that was asked for anything; pictures inside the page ask none."""
        urls = [url.removeprefix("blob:") for url in self.asked if not url.startswith("data:")]
        return {str(urlsplit(url).hostname) for url in urls}


def blue(pixels: np.ndarray) -> float:
    """Share of pixels in the pad's blue."""
    r, g, b = np.moveaxis(pixels, -1, 0)
    return float(((b > 90) & (b > 2 * r) & (b > g + 40)).mean())


def is_pad_in_hall(pixels: np.ndarray) -> bool:
    """Whether the pad's blue is there, in a picture that is not of one colour."""
    return blue(pixels) > 0.02 and pixels.std() > 20.0


def free_port() -> int:
    """A port that nobody listens to."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


@contextmanager
def verb(tmp_path, *words):
    """A verb as it is typed, its browser a program that does nothing; ended by Ctrl-C."""
    command = [sys.executable, "-m", "falconwing_kit.tools.cli.main", *map(str, words)]
    quiet = {"BROWSER": "true", "PYTHONPATH": str(ROOT), "PYTHONUNBUFFERED": "1"}
    with subprocess.Popen(
        command, env={**os.environ, **quiet}, cwd=tmp_path, stdout=subprocess.PIPE, text=True
    ) as running:
        try:
            yield running
        finally:
            running.send_signal(signal.SIGINT)
            running.wait(60)


def watched_landing(browser, tmp_path) -> float:
    """`demo` watched from its first line to the landing -> how much its nose picture changed.

    Near 0 where the page on a busy machine began after the landing.
    """
    url = f"http://127.0.0.1:{(port := free_port())}/"
    with verb(tmp_path, "demo", "--port", port, "--out", tmp_path / "out") as demo:
        assert demo.stdout.readline().strip() == f"live page: {url}"
        visit = Visit(browser, url)
        visit.says("AUTOPILOT")
        visit.until(lambda page: page.get_attribute("#nose", "data-pictures"))
        first = visit.picture("#nose")
        assert "landed on the pad" in demo.stdout.readline()
        visit.says("from the centre line")
        assert (tmp_path / "out" / "approach.mcap").is_file()
        visit.until(lambda _: blue(visit.look("#nose")) > 0.1)
        last = visit.picture("#nose")
        visit.until(lambda _: is_pad_in_hall(visit.look(".hall-canvas")))
        visit.says("SIMULATION")
        assert not visit.page.is_visible("#link")  # nobody can join a flight
        assert visit.hosts() == {"127.0.0.1"} and visit.complaints == []
        visit.page.close()
    return float(np.abs(first - last).mean())


def test_demo_flies_on_the_wall_and_its_log_in_the_player(browser, tmp_path):
    """From the first line on the terminal to the landing: the nose picture, the hall with its pad,
    and no other host. Then `replay` shows the log in its hall, and the scrub bar moves it.
    """
    flights = (watched_landing(browser, tmp_path) for _ in range(FLIGHTS))
    assert next((change for change in flights if change > 20.0), None) is not None
    port, log = free_port(), tmp_path / "out" / "approach.mcap"
    with verb(tmp_path, "replay", log, "--port", port, "--speed", "0.25") as replay:
        assert f"http://127.0.0.1:{port}/?speed=0.25" in replay.stdout.readline()
        visit = Visit(browser, f"http://127.0.0.1:{port}/?speed=0.25")
        visit.until(lambda page: page.query_selector("#flight [data-t]"))
        visit.says("touched pad")
        assert visit.page.get_attribute("#flight [data-t]", "data-rate") == "0.25"
        visit.until(lambda page: blue(visit.look("#flight canvas >> nth=0")) > 0.005)
        visit.page.keyboard.press("Home")
        visit.page.eval_on_selector(
            "#flight input[type=range]",
            "r => { r.value = r.max; r.dispatchEvent(new Event('input', {bubbles: true})); }",
        )
        visit.until(lambda page: float(page.get_attribute("#flight [data-t]", "data-t")) > 3.0)
        assert visit.hosts() == {"127.0.0.1"} and visit.complaints == []
        visit.page.close()
    assert replay.returncode == 0


def test_a_flight_waits_until_the_hall_is_drawn(browser, monkeypatch):
    """As long as there is no hall, to the limit; then only until a spectator sees its pad."""
    with FlightPage("hall", free_port()) as page:
        visit = Visit(browser, page.url)
        visit.says("being prepared")
        monkeypatch.setattr(flight_page, "HALL_S", 2.0)
        begin = time.monotonic()
        assert page.wait_for_viewer(0.0) and time.monotonic() - begin > 2.0
        page.set_scene(load_scene("hall"))
        monkeypatch.setattr(flight_page, "HALL_S", 2.0 * PATIENCE_S)
        begin = time.monotonic()
        assert page.wait_for_viewer(0.0) and time.monotonic() - begin < PATIENCE_S
        seen = visit.look(".hall-canvas")
        assert blue(seen) > 0.005 and seen.std() > 20.0  # the pad is further away here
        assert visit.complaints == []
        visit.page.close()


def flown(k: int, mode: str = "straight on") -> LoopStep:
    """A step without a pose, as a real log may be, with a view that changes."""
    pixels = np.zeros((240, 320, 3), np.uint8)
    pixels[:, : 4 * (k % 80)] = (255, 160, 0)
    return LoopStep(
        0.05 * k, Image(k, 0.05 * k, pixels), None, Command(0.5, 0.0, 0.0, 0.0), mode, None
    )


def test_pictures_without_poses_reach_who_looks_on_and_who_comes_later(browser):
    """Two look on, one closes; the picture of the last step fills three quarters with orange."""
    with FlightPage(port=free_port(), simulated=False, has_poses=False) as page:
        page.show(flown(0))
        one, two = Visit(browser, page.url), Visit(browser, page.url)
        for visit in (one, two):
            visit.says("straight on")
            visit.says("REAL AIRCRAFT")
            visit.says("REPLAY")
        for k in range(1, 60):
            page.show(flown(k))
            time.sleep(0.02)
            if k == 30:
                one.page.close()
        late = Visit(browser, page.url)
        page.say("the end")
        for visit in (two, late):
            visit.says("the end")
            visit.says(f"{0.05 * 59:.1f} s")
        two.until(lambda _: two.look("#nose")[:, :, 0].mean() > 150.0)
        state = State(np.array([2.0, -2.0, 1.0]), 0.0, 0.0, 0.0, np.array([1.0, 0.0, 0.0]))
        page.show(LoopStep(0.0, None, state, Command(0.5, 0.0, 0.0, 0.0), "<b>again", None))
        for visit in (two, late):
            visit.says("Flight 2")
            visit.says("<b>again")
            assert visit.complaints == [] and visit.hosts() == {"127.0.0.1"}
