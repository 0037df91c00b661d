"""The scripted keyboard pilot keeps to its rules: late, few key changes; a landing of each kind."""

import numpy as np
import pytest

from falconwing_kit.aircraft.touchdown import LandingPad
from tests.benchmarks.keyboard_pilot import (
    CHANGES,
    REACTION_S,
    WITHIN_S,
    KeyboardPilot,
    Shown,
    land_by_keys,
    stick_area,
    tap_seconds,
)
from tests.tools.classroom.stick_keys import key_step


@pytest.mark.parametrize("seconds", [0.1, 0.3, 0.5, 0.8])
def test_area_of_a_tap_is_the_sum_of_its_stick(seconds):
    """Summed in steps of 1 ms with the keys' own law."""
    sticks, area = {"throttle": 0.0, "aileron": 0.0, "elevator": 0.0, "rudder": 0.0}, 0.0
    for k in range(2000):
        sticks = key_step(sticks, {"aileron": int(k < round(1000 * seconds))}, 1e-3)
        area += 1e-3 * sticks["aileron"]
    assert stick_area(seconds) == pytest.approx(area, abs=1e-3)
    assert tap_seconds(stick_area(seconds)) == pytest.approx(seconds, abs=1e-9)


@pytest.mark.parametrize("assist", [True, False])
def test_no_more_than_four_key_changes_in_any_second(assist):
    """Shown a flight of large random errors for 20 s, it is as busy as it may be."""
    rng, pilot = np.random.default_rng(4), KeyboardPilot(LandingPad(), assist)
    down, changes = {}, []
    for k in range(1000):
        t = 0.02 * k
        if k % 5 == 0:
            place = np.array([-15.0 + 0.1 * t, *rng.uniform((-5.0, 0.2), (1.0, 3.0))])
            pilot.look(Shown(t, place, float(rng.uniform(-0.5, 0.5)), 0.2))
        keys = pilot.keys(t)
        changes += [t] * sum(keys.get(name) != down.get(name) for name in {*keys, *down})
        down = keys
    spans = np.array(changes[CHANGES:]) - np.array(changes[:-CHANGES])
    assert spans.min() > WITHIN_S - 0.021  # of keys that are read every 20 ms
    assert len(changes) > 30


def test_what_is_shown_acts_a_reaction_time_later():
    """Shown the same until 1 s, two pilots press the same keys until 1.25 s, and not after."""
    pressed = []
    for side in (1.0, -1.0):
        pilot, keys = KeyboardPilot(LandingPad(), assist=True), []
        for k in range(100):
            t = 0.02 * k
            left = 0.0 if t < 1.0 else side * 3.0
            if k % 5 == 0:
                place = np.array([-19.0 + 7.0 * t, -2.0 + left, 0.6])
                pilot.look(Shown(t, place, 0.0, 0.5))
            keys.append(pilot.keys(t))
        pressed.append(keys)
    first = next(k for k, (a, b) in enumerate(zip(*pressed, strict=True)) if a != b)
    assert 0.02 * first == pytest.approx(1.0 + REACTION_S, abs=0.021)


@pytest.mark.parametrize("assist", [True, False])
def test_it_lands(assist):
    """On a training seed, by the task's own evaluator."""
    found = land_by_keys(501, assist)
    assert found["success"] and found["reason"] == "touched pad"
    assert found["key_changes"] <= CHANGES * (found["seconds"] + 1.0)
