"""Lab 10, hidden: the cases and their references, independent of the lab's solution."""

import math
from collections.abc import Mapping
from functools import partial
from typing import Any

import numpy as np

from falconwing_kit.tools.grading import Course, Function, Judge, Trials, Values
from falconwing_kit.trainer_port import Stick

NAMES = {"T": "throttle", "A": "aileron", "E": "elevator", "R": "rudder"}
STEPS = 160  # of one trace of the safety machine


def judges(course: Course) -> Mapping[str, tuple[Judge, ...]]:
    """The judges of each exercise."""
    gap_us, centre_us = int(course.constants["gap_us"]), int(course.constants["centre_us"])
    hold_ms, lost_ms = course.constants["hold_ms"], course.constants["lost_ms"]
    return {
        "encode_ppm": (
            Values(
                _sticks, partial(_edges, gap_us=gap_us, centre_us=centre_us), cases=24, rtol=0.0
            ),
        ),
        "decode_ppm": (Values(_stream, _frames_by_machine, cases=24, rtol=0.0),),
        "failsafe_state": (
            Trials(partial(_same_states, hold_ms=hold_ms, lost_ms=lost_ms), trials=20),
        ),
        "ssim_monitor": (Values(_pictures, _by_loops, cases=16, rtol=1e-7, atol=1e-9),),
    }


def _sticks(rng: np.random.Generator) -> tuple[Any, ...]:
    """Sticks in and beyond their limits, now and then one that is no number.

    No half microseconds.
    """
    us = rng.integers(-700, 701, 4) + rng.uniform(-0.45, 0.45, 4)
    values = us / 500.0
    values[0] = (values[0] + 1.0) / 2.0
    sticks = dict(zip(NAMES.values(), map(float, values), strict=True))
    if rng.random() < 0.2:
        sticks[str(rng.choice(list(NAMES.values())))] = float(rng.choice([np.nan, np.inf, -np.inf]))
    return sticks, "".join(rng.permutation(list("TAER"))), int(rng.integers(65536))


def _edges(
    sticks: dict[str, float], order: str, start_tick: int, gap_us: int, centre_us: int
) -> np.ndarray:
    """By the kit's calibration of a radio, then tick by tick."""
    if not all(map(math.isfinite, sticks.values())):
        sticks = {name: 0.0 for name in sticks}
    slots = {}
    for letter, name in NAMES.items():
        low, high = (0.0, 1.0) if letter == "T" else (-1.0, 1.0)
        stick = Stick(1, centre_us - 500, centre_us, centre_us + 500)
        cut = min(max(sticks[name], low), high)
        slots[letter] = stick.to_us(2.0 * cut - 1.0 if letter == "T" else cut)
    tick, edges = start_tick, []
    for us in (*(slots[letter] for letter in order), 0):
        edges += [tick % 65536, (tick + 2 * gap_us) % 65536]
        tick += 2 * us
    return np.array(edges)


def _stream(rng: np.random.Generator) -> tuple[Any, ...]:
    """Frames of one radio with lost pulses and sparks, from somewhere in the first frame on.

    Two at least are good.
    """
    channels = int(rng.integers(4, 8))
    gaps: list[float] = [float(rng.integers(2000, 9000))]
    good = rng.permutation([True, True, *(rng.random(6) < 0.5)])
    for is_good in good:
        slots = list(rng.integers(1600, 4401, channels) / 2.0)
        if not is_good:
            slots = _spoilt(slots, rng)
        pause = float(rng.choice([4000.0, rng.integers(8000, 20000) / 2.0]))
        gaps += [*slots, pause]
    ticks = rng.integers(65536) + np.concatenate([[0.0], np.cumsum(2.0 * np.array(gaps))])
    return ticks.astype(np.int64)[int(rng.integers(3)) :] % 65536, channels


def _spoilt(slots: list[float], rng: np.random.Generator) -> list[float]:
    """A frame with a lost pulse, a spark, both, an invalid slot, or one slot too many."""
    fault, at = int(rng.integers(5)), int(rng.integers(len(slots) - 1))
    if fault in (0, 2):
        slots = [*slots[:at], slots[at] + slots[at + 1], *slots[at + 2 :]]
        slots = [min(us, 3999.5) for us in slots]
    if fault in (1, 2):
        at = int(rng.integers(len(slots)))
        slots = [*slots[:at], 300.0, slots[at] - 300.0, *slots[at + 1 :]]
    if fault == 3:
        slots[at] = float(rng.choice([799.5, 2200.5, 400.0, 3500.0]))
    if fault == 4:
        slots = [*slots, 1000.0]
    return slots


def _frames_by_machine(ticks: np.ndarray, channels: int) -> np.ndarray:
    """Pulse by pulse, as an interrupt would: collect slots, and judge them when the pause comes."""
    frames, slots, began = [], [], False
    before = None
    for tick in ticks:
        if before is not None:
            us = ((int(tick) - int(before)) % 65536) / 2.0
            if us < 4000.0:
                slots.append(us)
            else:
                if (
                    began
                    and len(slots) == channels
                    and min(slots) >= 800.0
                    and max(slots) <= 2200.0
                ):
                    frames.append(slots)
                slots, began = [], True
        before = tick
    return np.array(frames, float) if frames else np.zeros((0, channels))


def _trace(
    rng: np.random.Generator, hold_ms: float, lost_ms: float
) -> list[tuple[float, bool, bool, bool]]:
    """A host that flies, falls silent for a while, lets go; a pilot who steps in.

    And steps of uneven length.
    """
    steps: list[tuple[float, bool, bool, bool]] = [
        (22.0, True, False, False),
        *[(22.0, True, True, False)] * 6,
    ]
    while len(steps) < STEPS:
        what, n, dt = int(rng.integers(8)), int(rng.integers(3, 9)), float(rng.integers(18, 27))
        engage, asks = bool(rng.random() < 0.5), [(dt, True, True, False)] * n
        if (
            what < 2
        ):  # silent for exactly as long as a limit or a little shorter, all at once or in two parts
            limit, first = (
                float(rng.choice([hold_ms, lost_ms])) - float(rng.integers(2)),
                float(rng.integers(1, 50)),
            )
            parts = [limit] if rng.random() < 0.5 else [first, limit - first]
            steps += [(part, False, engage, False) for part in parts] + asks * (rng.random() < 0.6)
        elif what == 2:
            steps += [(dt, False, engage, False)] * n
        elif what == 3:
            steps += [(dt, bool(rng.random() < 0.7), engage, True), *asks]
        elif what == 4:
            steps += [(dt, True, False, False)] * int(rng.integers(1, 3))
        elif what == 5:  # off, and nearly enough good frames
            steps += [
                (dt, True, False, False),
                *[(dt, True, True, False)] * int(rng.integers(3, 5)),
            ]
        else:
            steps += [(dt, True, False, False)] * (rng.random() < 0.7) + asks
    return steps


def _same_states(
    student: Function, rng: np.random.Generator, hold_ms: float, lost_ms: float
) -> bool:
    memory: Any = {"state": "SAFE", "armed": False, "good": 0, "age_ms": 0.0}
    history: list[tuple[float, bool, bool, bool]] = []
    expected = "SAFE"
    for inputs in _trace(rng, hold_ms, lost_ms):
        memory = student(memory, *inputs)
        history.append(inputs)
        expected = _state(expected, history, hold_ms, lost_ms)
        if not isinstance(memory, dict) or memory.get("state") != expected:
            return False
    return True


def _state(
    before: str, history: list[tuple[float, bool, bool, bool]], hold_ms: float, lost_ms: float
) -> str:
    """The state from the previous state and the whole history, without counters."""
    _, valid, engage, pilot_moved = history[-1]
    if pilot_moved or (valid and not engage):
        return "SAFE"
    if not valid:
        silence = 0.0
        for dt_ms, was_valid, *_ in reversed(history):
            if was_valid:
                break
            silence = dt_ms + silence
        if before in ("ACTIVE", "HOLD"):
            return (
                "LOST"
                if silence >= lost_ms
                else "HOLD"
                if silence >= hold_ms or before == "HOLD"
                else "ACTIVE"
            )
        return before
    if before == "HOLD":
        return "ACTIVE"
    if before != "SAFE":
        return before
    last = history[
        -6:
    ]  # five engage frames in a row, and before them the host disengaged and no stick moved
    asked = all(
        was_valid and was_engaged and not moved for _, was_valid, was_engaged, moved in last[-5:]
    )
    return "ACTIVE" if asked and len(history) > 5 and _armed(history[:-5]) else "SAFE"


def _armed(history: list[tuple[float, bool, bool, bool]]) -> bool:
    """Whether the last word of host or pilot that counts was a host that let go.

    Frames that ask do not change it.
    """
    for _, valid, engage, pilot_moved in reversed(history):
        if pilot_moved:
            return False
        if valid and not engage:
            return True
    return False


def _pictures(rng: np.random.Generator) -> tuple[Any, ...]:
    """Runs of calm, noisy, half noisy and frozen pictures.

    Similarities stay far from the threshold.
    """
    height, width, count = (
        8 * int(rng.integers(2, 5)),
        16 * int(rng.integers(1, 3)),
        int(rng.integers(2, 6)),
    )
    coarse = rng.integers(30, 226, (height // 4, width // 4))
    base = np.kron(coarse, np.ones((4, 4)))
    pictures = [base]
    for kind in (*rng.permutation(4), *rng.integers(0, 4, 2)):
        for _ in range(int(rng.integers(1, count + 3))):
            picture = base + rng.normal(0.0, 6.0, base.shape) if kind < 3 else pictures[-1]
            snow = (0, width, width // 2, 0)[kind]  # columns
            picture = np.concatenate(
                [rng.uniform(0.0, 255.0, (height, snow)), picture[:, snow:]], axis=1
            )
            pictures.append(picture)
    images = np.clip(np.round(pictures), 0, 255).astype(np.uint8)
    return images, float(rng.choice([rng.uniform(0.2, 0.28), rng.uniform(0.72, 0.8)])), count


def _by_loops(images: np.ndarray, threshold: float, count: int) -> tuple[np.ndarray, np.ndarray]:
    """Block by block with numpy.cov, and alarms by counting runs."""
    ssim, alarm, noisy, still = [], [], 0, 0
    for x, y in zip(images[:-1].astype(float), images[1:].astype(float), strict=True):
        values = []
        for row in range(0, x.shape[0], 8):
            for column in range(0, x.shape[1], 8):
                a, b = (image[row : row + 8, column : column + 8].ravel() for image in (x, y))
                (aa, ab), (_, bb) = np.cov(a, b, bias=True)
                top = (2 * a.mean() * b.mean() + 6.5025) * (2 * ab + 58.5225)
                values.append(
                    top / ((a.mean() ** 2 + b.mean() ** 2 + 6.5025) * (aa + bb + 58.5225))
                )
        ssim.append(math.fsum(values) / len(values))
        noisy = noisy + 1 if ssim[-1] < threshold else 0
        still = still + 1 if np.abs(x - y).mean() < 0.5 else 0
        alarm.append(1 if noisy >= count else 2 if still >= count else 0)
    return np.array(ssim), np.array(alarm)
