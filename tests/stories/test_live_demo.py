"""The live page in a real browser: `falconwing demo` as it is typed, watched in headless Chromium.

Needs Debian's `chromium` and Playwright. In CI both must be there: a missing one fails; elsewhere
it skips.
"""

import io
import os
import signal
import socket
import subprocess
import sys
import time
from pathlib import Path
from urllib.parse import urlsplit

import numpy as np
import pytest
from PIL import Image as Picture

from falconwing_kit.core.messages import Command, Image, State
from falconwing_kit.flight.loop import LoopStep
from falconwing_kit.scene.arena import load_scene
from falconwing_kit.tools.demo.live_page import LivePage
from tests.chromium import headless_chromium

ROOT = Path(__file__).resolve().parents[2]
WAIT_MS = 120_000  # of anything in the browser: software drawing on a busy machine is slow
# What the browser may complain of: a view that was replaced before it was shown.
ALLOWED = ("Failed to load resource: net::ERR_FILE_NOT_FOUND",)

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
        self.page = browser.new_page(viewport={"width": 1000, "height": 700})
        self.page.set_default_timeout(WAIT_MS)
        self.asked, self.complaints = [], []
        self.page.on("request", lambda request: self.asked.append(request.url))
        self.page.on("websocket", lambda connection: self.asked.append(connection.url))
        self.page.on(
            "console",
            lambda said: self.complaints.append(said.text) if said.type == "error" else None,
        )
        self.page.on("pageerror", lambda error: self.complaints.append(str(error)))
        self.page.goto(url)

    def wait_for(self, words: str) -> None:
        """Until the page shows these words."""
        self.page.wait_for_function(
            "words => document.body.innerText.includes(words)", arg=words, polling=100
        )

    def look(self) -> tuple[np.ndarray, np.ndarray]:
        """The hall, left of the panel, and the view from the nose, each (H, W, 3) as they stand on
        the screen.
        """
        screen = Picture.open(io.BytesIO(self.page.screenshot())).convert("RGB")
        frames = self.page.evaluate(
            "[...document.images].map(i => i.getBoundingClientRect().toJSON())"
        )
        x, y, right, bottom = max(
            ((f["left"], f["top"], f["right"], f["bottom"]) for f in frames),
            key=lambda f: (f[2] - f[0]) * (f[3] - f[1]),
        )
        hall, view = (
            screen.crop((0, 0, round(x) - 20, screen.height)),
            screen.crop((x, y, right, bottom)),
        )
        return np.asarray(hall).astype(int), np.asarray(view).astype(int)

    def hosts(self) -> set[str]:
        """Every host that was asked for anything; pictures inside the page ask none."""
        urls = [url.removeprefix("blob:") for url in self.asked if not url.startswith("data:")]
        return {str(urlsplit(url).hostname) for url in urls}


def blue(pixels: np.ndarray) -> float:
    """Share of pixels in the pad's blue."""
    r, g, b = np.moveaxis(pixels, -1, 0)
    return float(((b > 90) & (b > 2 * r) & (b > g + 40)).mean())


def aircraft_colours(hall: np.ndarray) -> set[str]:
    """Which of its colours the aircraft shows, in the middle, where the camera that follows has it.

    Its wing is about 120 px long there and 10 px deep, a quarter of it red: a quarter of that must
        be seen.
    """
    middle_y, middle_x = hall.shape[0] // 2, hall.shape[1] // 2
    seen = hall[middle_y - 50 : middle_y + 70, middle_x - 120 : middle_x + 100]
    r, g, b = np.moveaxis(seen, -1, 0)
    red = (
        (r > 120) & (r > 2 * g) & (r > 2 * b) & (np.abs(g - b) < 30)
    )  # the path is orange: more green than blue
    white = (seen.min(axis=-1) > 190) & (np.ptp(seen, axis=-1) < 25)
    return {
        name
        for name, share in (("red", red), ("white", white))
        if share.sum() > (75 if name == "red" else 225)
    }


def free_port() -> int:
    """A port that nobody listens to."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


def flown(k: int) -> LoopStep:
    """A step over the pad, low and level, with a view that changes; nothing of it is a flight of
    the model.
    """
    pixels = np.zeros((240, 320, 3), np.uint8)
    pixels[:, : 4 * (k % 80)] = (255, 160, 0)
    state = State(np.array([2.0 + 0.05 * k, -2.0, 1.0]), 0.0, 0.0, 0.0, np.array([1.0, 0.0, 0.0]))
    return LoopStep(
        0.05 * k,
        Image(k, 0.05 * k, pixels),
        state,
        Command(0.5, 0.0, 0.0, 0.0),
        "straight on",
        None,
    )


@pytest.fixture
def demo(tmp_path):
    """The verb as it is typed, its browser a program that does nothing; ended by Ctrl-C."""
    port = free_port()
    words = [
        sys.executable,
        "-m",
        "falconwing_kit.tools.cli.main",
        "demo",
        "--port",
        str(port),
        "--out",
        str(tmp_path / "out"),
    ]
    quiet = {"BROWSER": "true", "PYTHONPATH": str(ROOT), "PYTHONUNBUFFERED": "1"}
    with subprocess.Popen(
        words, env={**os.environ, **quiet}, cwd=tmp_path, stdout=subprocess.PIPE, text=True
    ) as verb:
        yield verb, f"http://127.0.0.1:{port}", tmp_path / "out"
        verb.send_signal(signal.SIGINT)
        verb.wait(60)


def test_demo_flies_in_the_browser(browser, demo):
    """From the first line on the terminal to the landing: view, hall, pad and aircraft are there,
    and no other host.
    """
    verb, url, out = demo
    assert verb.stdout.readline().strip() == f"live page: {url}"
    visit = Visit(browser, url)
    visit.page.wait_for_selector("canvas")
    visit.wait_for("SIMULATION")
    visit.wait_for("approach")
    _, first = visit.look()
    assert "landed on the pad" in verb.stdout.readline()
    visit.wait_for("flare")
    assert (out / "approach.mcap").is_file()
    visit.page.wait_for_timeout(3000)  # what is drawn last
    hall, last = visit.look()
    assert first.std() > 20.0 and last.std() > 20.0 and np.abs(first - last).mean() > 20.0
    assert blue(last) > 0.10  # the aircraft stands on the pad
    assert hall.std() > 20.0
    assert blue(hall) > 0.02
    assert aircraft_colours(hall) >= {"red", "white"}
    for words in ("throttle", "elevator", "height [m]", "speed [m/s]", "follow the aircraft"):
        visit.wait_for(words)
    assert visit.hosts() <= {"127.0.0.1", "localhost"}
    assert [said for said in visit.complaints if not said.startswith(ALLOWED)] == []
    visit.page.close()


def test_browsers_come_and_go_and_the_flight_goes_on(browser):
    """Two look on, one closes in mid-flight; the other sees the last step, and so does one that
    comes later.
    """
    with LivePage(load_scene("arena"), free_port()) as page:
        page.show(flown(0))
        one, two = Visit(browser, page.url), Visit(browser, page.url)
        for visit in (one, two):
            visit.wait_for("straight on")
        for k in range(1, 60):
            page.show(flown(k))
            time.sleep(0.02)
            if k == 30:
                one.page.close()
        assert page._thread.is_alive()
        late = Visit(browser, page.url)
        for visit in (two, late):
            visit.wait_for(f"{0.05 * 59:.1f} s")
            visit.page.wait_for_timeout(2000)
            assert (
                visit.look()[1][:, :, 0].mean() > 100.0
            )  # three quarters of the last view are orange
            assert visit.hosts() <= {"127.0.0.1", "localhost"}
            assert [said for said in visit.complaints if not said.startswith(ALLOWED)] == []


def test_camera_stays_where_its_user_takes_it(browser):
    """With the box ticked the hall moves past as the aircraft flies; unticked the picture stands
    still.
    """
    with LivePage(load_scene("arena"), free_port()) as page:
        page.show(flown(0))
        visit = Visit(browser, page.url)
        visit.wait_for("straight on")
        visit.page.wait_for_timeout(3000)
        seen = [visit.look()[0]]
        for k, tick in ((60, False), (120, True)):
            if tick:
                visit.page.get_by_role("checkbox").first.click()
                visit.page.wait_for_timeout(500)
            page.show(flown(k))
            visit.page.wait_for_timeout(3000)
            seen.append(visit.look()[0])
        corner = np.s_[600:, :200]  # floor, far from the aircraft
        assert np.abs(seen[1] - seen[0])[corner].mean() > 2.0
        assert np.abs(seen[2] - seen[1])[corner].mean() < 0.5
