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
from tests.tools.classroom.stick_keys import key_step

pytestmark = [pytest.mark.benchmark, pytest.mark.timeout(900)]
FLIGHTS = 10
GOALS = {"with the beginner's assist": (True, 0.8), "without": (False, 0.4)}
KEYS = {
    ("aileron", 1): "ArrowRight", ("aileron", -1): "ArrowLeft", ("elevator", 1): "ArrowDown",
    ("elevator", -1): "ArrowUp", ("throttle", 1): "KeyW", ("throttle", -1): "KeyS",
}  # fmt: skip
PAD_SCRIPT = """
globalThis.pad = null;
navigator.getGamepads = () => [globalThis.pad, null, null, null];
globalThis.setPad = (axes, held) => {
  const button = (_, i) => ({ pressed: held && i === 5, value: Number(held && i === 5) });
  const buttons = Array.from({ length: 17 }, button);
  const pad = { connected: true, id: "test pad", index: 0, mapping: "standard" };
  globalThis.pad = { ...pad, axes, buttons };
};
"""
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
        self._browser, self._address = browser, re.search(r"http\S+", address)[0]
        self.page = self.seat("Ada", assist)

    def seat(self, name: str, assist: bool, script: str = "", **settings: float) -> Any:
        """A seat that asks for the sticks, with these settings of the sticks."""
        page = self._browser.new_page(viewport={"width": 1280, "height": 800})
        kept = json.dumps(json.dumps({"assist": assist, **settings}))
        page.add_init_script(f"localStorage.setItem('falconwing.sticks', {kept});{script}")
        page.goto(self._address)
        page.wait_for_selector("html[data-connected=true]")
        assert page.evaluate("globalThis.classroomPage.settings.assist") == assist
        page.evaluate(WATCH)
        page.fill("#name", name)
        page.click("#ask")
        return page

    def close(self) -> None:
        """End the class."""
        self.process.send_signal(signal.SIGINT)
        try:
            self.process.communicate(timeout=30)
        finally:
            self.process.kill()


class Keyboard:
    """The keys of a page."""

    def __init__(self, page: Any) -> None:
        self._page, self._down = page, set[str]()

    def hold(self, on: bool) -> None:
        """Press or release the hold button."""
        (self._page.keyboard.down if on else self._page.keyboard.up)("Space")

    def press(self, keys: dict[str, int]) -> None:
        """Hold down these keys and no others: sticks and their sides."""
        wanted = {KEYS[stick, side] for stick, side in keys.items()}
        for key in self._down - wanted:
            self._page.keyboard.up(key)
        for key in wanted - self._down:
            self._page.keyboard.down(key)
        self._down = wanted


class Gamepad:
    """A synthetic gamepad whose sticks go where a key would take them; a page with PAD_SCRIPT and
    neither dead band nor expo.
    """

    def __init__(self, page: Any) -> None:
        self._page, self._is_held, self._at = page, False, time.monotonic()
        self._sticks = {"throttle": 0.5, "aileron": 0.0, "elevator": 0.0, "rudder": 0.0}

    def hold(self, on: bool) -> None:
        """Press or release a shoulder button."""
        self._is_held = on
        self._show()

    def press(self, keys: dict[str, int]) -> None:
        """Move the sticks on."""
        now = time.monotonic()
        self._sticks, self._at = key_step(self._sticks, keys, now - self._at), now
        self._show()

    def _show(self) -> None:
        sticks = self._sticks
        axes = [sticks["rudder"], 0.0, sticks["aileron"], sticks["elevator"]]
        self._page.evaluate("([axes, held]) => setPad(axes, held)", [axes, self._is_held])


def land(page: Any, assist: bool, after: int, hand: Any = None) -> tuple[int, bool, str, float]:
    """Number, success and sentence of the next flight that is flown from its beginning, and the
    share of its states in which the student held the sticks; hand: None for the keyboard.
    """
    hand = hand or Keyboard(page)
    pilot, number, held = KeyboardPilot(LandingPad(), assist), 0, []
    t, end = 0.0, time.monotonic() + 120.0
    while time.monotonic() < end:
        states, verdict, age, is_holding = page.evaluate(LOOK)
        if not number and not is_holding:  # a button counts from when the sticks are given
            hand.hold(False)
            time.sleep(0.2)
            hand.hold(True)
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
        hand.press(pilot.keys(t + min(age, CONTROL_PERIOD_S)) if number else {})
        time.sleep(0.005)
    else:
        raise AssertionError("no flight ended")
    hand.press({})
    hand.hold(False)
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
