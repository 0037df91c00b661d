"""A class in a real browser: wall, desk and two phones at once; the sticks change hands by keyboard
and gamepad; a flight is watched again, and its file opens from disk.

The simulated aircraft flies in a process of its own, as `falconwing class` starts it.
"""

import re
import signal
import subprocess
import sys
import time
import urllib.request
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from falconwing_kit.core.flight_log import read_flight_log
from tests.benchmarks.bench_keyboard_page import PAD_SCRIPT, Class, Gamepad, Keyboard, land
from tests.chromium import headless_chromium

TRIES = 3  # to land
PATIENCE_S = 90.0  # for anything to happen, on a busy machine
# Drawing the hall by software would keep both cores busy; other tests draw it.
FLAGS = ["--disable-3d-apis"]
PAD = """
globalThis.pad = null;
navigator.getGamepads = () => [globalThis.pad, null, null, null];
"""
PRESS_SHOULDER = """() => {
  const button = (_, i) => ({ pressed: i === 5, value: Number(i === 5) });
  const buttons = Array.from({ length: 17 }, button);
  const rest = { connected: true, id: "test pad", index: 0, mapping: "standard", timestamp: 1 };
  globalThis.pad = { ...rest, axes: [0, 0, 0, 0], buttons };
}"""
LET_GO = "() => { globalThis.pad = null; }"
HOLD_AGAIN = "HOLD AGAIN"  # on the button of a seat whose sticks were taken while it held
SLEEP = "() => { const end = performance.now() + 900; while (performance.now() < end); }"


def until(what: Callable[[], Any]) -> Any:
    """What a page says at last; a page's own wait needs an eval that its policy forbids."""
    end = time.monotonic() + PATIENCE_S
    while not (answer := what()):
        assert time.monotonic() < end, "nothing happened"
        time.sleep(0.05)
    return answer


@pytest.fixture
def school(tmp_path):
    """A running class: its addresses and the folder of its logs."""
    command = [
        sys.executable, "-m", "falconwing_kit.tools.cli.main", "class", "--no-browser",
        "--web-port", "0", "--laps", "1", "--out", str(tmp_path / "logs"),
    ]  # fmt: skip
    process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True)
    lines = [process.stdout.readline() for _ in range(4)]
    seat, wall, desk = (re.search(r"http\S+", line)[0] for line in lines[1:])
    yield {"/": seat, "wall": wall, "desk": desk, "logs": tmp_path / "logs"}
    process.send_signal(signal.SIGINT)
    try:
        rest = process.communicate(timeout=PATIENCE_S)[0]
    finally:
        process.kill()
    assert process.returncode == 0 and "Traceback" not in rest, rest


def ask(seat: Any, name: str) -> None:
    """Give a name and ask for the sticks."""
    seat.fill("#name", name)
    seat.click("#ask")


def test_a_class(school, tmp_path):
    """Mia flies by keyboard until her phone falls asleep; Ben by gamepad until the teacher takes
    the sticks back, which beats his button; then the flight's end, again and as a file.
    """
    with headless_chromium(FLAGS) as browser:
        context = browser.new_context(viewport={"width": 1280, "height": 720})
        phone = browser.new_context(viewport={"width": 390, "height": 844})
        phone.add_init_script(PAD)
        faults: list[str] = []
        pages = {}
        for name, where in (("wall", context), ("desk", context), ("Mia", phone), ("Ben", phone)):
            pages[name] = where.new_page()
            pages[name].on("pageerror", lambda error: faults.append(str(error)))
            pages[name].goto(school.get(name, school["/"]))
        wall, desk, mia, ben = pages.values()

        def who() -> str:
            return wall.text_content("#who")

        def fly(seat: Any, name: str, press: Callable[[], Any], release: Callable[[], Any]) -> None:
            """Be given the sticks, and hold; again where a wall was too near."""
            ask(seat, name)
            until(lambda: name in desk.text_content("#queue"))
            desk.click(f"#queue li:has-text('{name}') >> text=Give")
            until(lambda: seat.is_visible("#hold"))
            seat.bring_to_front()
            for _ in range(20):
                press()
                if until(lambda: name in who() or HOLD_AGAIN in seat.text_content("#hold")) and (
                    name in who()
                ):
                    return
                release()
                time.sleep(0.5)
            raise AssertionError(f"{name} never flew")

        until(lambda: "AUTOPILOT" in who())
        desk.click("#speeds >> text=0.25")  # a wall comes four times as late
        fly(mia, "Mia", lambda: mia.keyboard.down("Space"), lambda: mia.keyboard.up("Space"))
        mia.evaluate(SLEEP)
        until(lambda: "AUTOPILOT" in who())
        mia.keyboard.up("Space")
        fly(ben, "Ben", lambda: ben.evaluate(PRESS_SHOULDER), lambda: ben.evaluate(LET_GO))
        desk.click("#take")
        until(lambda: "AUTOPILOT" in who())
        time.sleep(1.0)
        assert "AUTOPILOT" in who()  # Ben's button is still pressed
        desk.click("#speeds >> text=Real time")

        until(lambda: desk.is_visible("#after"))
        desk.click("#watch")
        player = "#replay [data-t]"
        until(lambda: desk.query_selector(player))
        before = desk.get_attribute(player, "data-t")
        desk.eval_on_selector(
            "#replay input[type=range]",
            "r => { r.value = r.max / 2; r.dispatchEvent(new Event('input', {bubbles: true})); }",
        )
        until(lambda: desk.get_attribute(player, "data-t") != before)
        assert len(desk.get_attribute(player, "data-ghost").split()) == 3
        address = desk.get_attribute("#keep", "href")
        assert not faults
        shared = _download(school["/"], address, tmp_path / "flight.html")
        alone = browser.new_context(offline=True)
        page = alone.new_page()
        page.goto(shared.as_uri())
        until(lambda: page.query_selector("[data-ready=true]"))
        assert "SIMULATION" in page.text_content("body")
    events = [
        event
        for log in sorted(school["logs"].glob("*.mcap"))
        for event in read_flight_log(log).events
        if event.name == "hands"
    ]
    holders = [(event.details["holder"], event.details["name"]) for event in events]
    assert holders.index(("student", "Mia")) < holders.index(("student", "Ben"))
    reasons = " ".join(str(event.details["reason"]) for event in events)
    assert "teacher" in reasons and "no sticks from Mia" in reasons


def test_landings_by_keyboard_and_by_gamepad():
    """With the beginner's assist each lands on the pad by the task's own judge, the sticks in hand
    for more than nine tenths of the flight; three tries each, for a busy machine loses key presses.
    """
    with headless_chromium(FLAGS) as browser:
        school = Class(browser, assist=True, seed=8)
        try:
            number = 0
            for hand in (Keyboard, Gamepad):
                page = school.page
                if hand is Gamepad:
                    page.close()
                    page = school.seat("Ben", True, PAD_SCRIPT, deadBand=0.0, expo=0.0)
                tries = []
                for _ in range(TRIES):
                    number, success, sentence, held = land(page, True, number, hand(page))
                    tries.append((success, held, sentence))
                    if success and held > 0.9:
                        break
                else:
                    raise AssertionError(f"{hand.__name__} never landed: {tries}")
        finally:
            school.close()


def _download(seat: str, address: str, path: Path) -> Path:
    """A file of the class on disk."""
    with urllib.request.urlopen(seat.rstrip("/") + address, timeout=PATIENCE_S) as answer:
        path.write_bytes(answer.read())
    return path
