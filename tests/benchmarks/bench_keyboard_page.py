"""The scripted keyboard pilot at the page itself: Chromium's keys -> seat -> server -> aircraft.

    python -m pytest -m benchmark -s tests/benchmarks/bench_keyboard_page.py

As bench_keyboard_pilot.py, with everything between in place: a class in a process of its own, its
seat in a browser, keys pressed in real time, and the verdict that the class gives. The pilot has
what the page has: the newest STATE message. SIMULATED; the hall is not drawn, since drawing it by
software on the same two cores would slow the class.
"""

import json
import os
import re
import signal
import subprocess
import sys
import time
from typing import Any

import numpy as np
import pytest

from falconwing_kit.aircraft.touchdown import LandingPad
from falconwing_kit.core.messages import CONTROL_PERIOD_S
from tests.benchmarks.keyboard_pilot import KeyboardPilot, Shown
from tests.chromium import headless_chromium

pytestmark = [pytest.mark.benchmark, pytest.mark.timeout(900)]
FLIGHTS = 10
GOALS = {"with the beginner's assist": (True, 0.8), "without": (False, 0.4)}
KEYS = {
    ("aileron", 1): "ArrowRight", ("aileron", -1): "ArrowLeft", ("elevator", 1): "ArrowDown",
    ("elevator", -1): "ArrowUp", ("throttle", 1): "KeyW", ("throttle", -1): "KeyS",
}  # fmt: skip
WATCH = """() => {
  globalThis.seen = { states: [], verdict: null, at: 0 };
  const channel = globalThis.classroomPage.channel;
  channel.on("state", (s) => {
    globalThis.seen.states.push([s.flight, s.t, ...s.pose, s.command[0], s.over ? 1 : 0,
      s.holder === "student" ? 1 : 0]);
    globalThis.seen.at = performance.now();
  });
  channel.on("verdict", (v) => { globalThis.seen.verdict = [v.flight, v.success, v.sentence]; });
}"""
LOOK = """() => {
  const { states, verdict, at } = globalThis.seen;
  const { holding } = globalThis.classroomPage;
  return [states.splice(0), verdict, (performance.now() - at) / 1000, Boolean(holding)];
}"""


class Class:
    """A class whose flights begin on the final approach, and the seat of its only student."""

    def __init__(self, browser: Any, assist: bool, seed: int) -> None:
        command = [
            sys.executable, "-m", "falconwing_kit.tools.cli.main", "class", "--no-browser",
            "--web-port", "0", "--laps", "0", "--seed", str(seed),
        ]  # fmt: skip
        self.process = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
        address = [self.process.stdout.readline() for _ in range(4)][1]
        self.page = browser.new_page(viewport={"width": 1280, "height": 800})
        kept = json.dumps(json.dumps({"assist": assist}))
        self.page.add_init_script(f"localStorage.setItem('falconwing.sticks', {kept})")
        self.page.goto(re.search(r"http\S+", address)[0])
        self.page.wait_for_selector("html[data-connected=true]")
        assert self.page.evaluate("globalThis.classroomPage.settings.assist") == assist
        self.page.evaluate(WATCH)
        self.page.fill("#name", "Ada")
        self.page.click("#ask")

    def close(self) -> None:
        """End the class."""
        self.process.send_signal(signal.SIGINT)
        try:
            self.process.communicate(timeout=30)
        finally:
            self.process.kill()


def land(page: Any, assist: bool, after: int) -> tuple[int, bool, str, float]:
    """Number, success and sentence of the next flight that is flown from its beginning, and the
    share of its states in which the student held the sticks.
    """
    pilot, down, number, held = KeyboardPilot(LandingPad(), assist), set(), 0, []
    t, end = 0.0, time.monotonic() + 120.0
    while time.monotonic() < end:
        states, verdict, age, is_holding = page.evaluate(LOOK)
        if not number and not is_holding:  # a button counts from when the sticks are given
            page.keyboard.up("Space")
            time.sleep(0.2)
            page.keyboard.down("Space")
            time.sleep(0.2)
        for flight, t_state, x, y, z, roll, _, _, throttle, over, is_held in states:
            if flight > after and not number and t_state < 0.2 and not over:
                number = flight
            if flight == number and not over:
                pilot.look(Shown(t_state, np.array([x, y, z]), roll, throttle))
                t = t_state
                held.append(is_held)
        if number and verdict and verdict[0] == number:
            break
        wanted = set()
        if number:
            keys = pilot.keys(t + min(age, CONTROL_PERIOD_S))
            wanted = {KEYS[stick, side] for stick, side in keys.items()}
        for key in down - wanted:
            page.keyboard.up(key)
        for key in wanted - down:
            page.keyboard.down(key)
        down = wanted
        time.sleep(0.005)
    else:
        raise AssertionError("no flight ended")
    for key in (*down, "Space"):
        page.keyboard.up(key)
    return *verdict, float(np.mean(held))


@pytest.mark.parametrize("name", GOALS)
def test_landings_at_the_page(name):
    """Prints each verdict; the goals are 4 of 5 with the assist and 2 of 5 without."""
    assist, goal = GOALS[name]
    landed = []
    with headless_chromium(["--disable-3d-apis"]) as browser:
        school = Class(browser, assist, seed=7 + assist)
        try:
            number = 0
            while len(landed) < FLIGHTS:
                number, success, sentence, held = land(school.page, assist, number)
                print(f"\nflight {number} {name}, {held:.0%} of it by keys: {sentence}", end="")
                if held > 0.0:  # else the sticks came too late for it: the autopilot's
                    landed.append(bool(success) and held > 0.9)
        finally:
            school.close()
    print(f"\n{name}: {sum(landed)} of {FLIGHTS} landed, load {os.getloadavg()[0]:.1f}")
    assert np.mean(landed) >= goal
