"""Lab 10, hidden: the cases and their references, independent of the lab's solution."""

import math
from collections.abc import Mapping
from functools import partial
from typing import Any

import numpy as np

from falconwing_kit.tools.grading import Course, Function, Judge, Trials, Values
from falconwing_kit.trainer_port import Safety, SafetyConfig, Stick

NAMES = {"T": "throttle", "A": "aileron", "E": "elevator", "R": "rudder"}
STEPS = 160  # of one trace of the safety machine


def judges(course: Course) -> Mapping[str, tuple[Judge, ...]]:
    """The judges of each exercise."""
    gap_us, centre_us = int(course.constants["gap_us"]), int(course.constants["centre_us"])
    config = SafetyConfig(
        safe_us=(centre_us - 500, *[centre_us] * 3, *[1500] * 4),
        host_timeout_ms=int(course.constants["lost_ms"]),
        engage_near_us=int(course.constants["near_us"]),
    )
    return {
        "encode_ppm": (
            Values(
                _sticks, partial(_edges, gap_us=gap_us, centre_us=centre_us), cases=24, rtol=0.0
            ),
        ),
        "decode_ppm": (Values(_stream, _frames_by_machine, cases=24, rtol=0.0),),
        "matches": (Trials(partial(_same_matches, config=config), trials=20),),
        "failsafe_state": (Trials(partial(_same_states, config=config), trials=30),),
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


Slots = tuple[float, ...]
Inputs = tuple[float, Slots | None, bool, Slots | None]


def _near(rng: np.random.Generator, config: SafetyConfig) -> tuple[Any, ...]:
    """A command and a pilot or none: near, at a limit, just beyond it in one slot, or far."""
    has_pilot = bool(rng.random() < 0.6)
    limits = np.full(4, config.engage_near_us)
    if not has_pilot:
        limits[0] = config.engage_idle_us
    sticks = rng.integers(1200, 1800, 4) if has_pilot else np.array(config.safe_us[:4])
    away = rng.integers(-limits, limits + 1)
    kind, channel = int(rng.integers(3)), int(rng.integers(4))
    if kind > 0:
        sign = int(rng.choice([-1, 1]))
        away[channel] = sign * (limits[channel] + (kind == 2) * int(rng.choice([1, 1, 60])))
    command = tuple(float(us) for us in sticks + away)
    return command, tuple(float(us) for us in sticks) if has_pilot else None


def _same_matches(student: Function, rng: np.random.Generator, config: SafetyConfig) -> bool:
    """Eight commands, some that match and some that do not."""
    cases = [_near(rng, config) for _ in range(8)]
    expected = [_engages(*case, config=config) for case in cases]
    if len(set(expected)) == 1:  # so that no constant answer is right
        return _same_matches(student, rng, config)
    answers = [student(*case) for case in cases]
    return all(
        isinstance(mine, (bool, np.bool_)) and bool(mine) == its
        for mine, its in zip(answers, expected, strict=True)
    )


def _engages(command_us: Slots, pilot_us: Slots | None, config: SafetyConfig) -> bool:
    """Whether the model of the board's program becomes ACTIVE on five of these commands."""
    safety = Safety(config)
    for number in range(6):
        now_us = 20_000 * number
        safety.tick(now_us, None if pilot_us is None else [round(us) for us in pilot_us])
        safety.frame(now_us, number, number > 0, [round(us) for us in command_us])
    return safety.state == "ACTIVE"


def _trace(rng: np.random.Generator, config: SafetyConfig) -> list[Inputs]:
    """A host that asks, flies, falls silent for a while, lets go; a pilot who steps in, or is not
    measured; and steps of uneven length.
    """
    safe = tuple(float(us) for us in config.safe_us[:4])
    pilot: Slots | None = safe if rng.random() < 0.3 else None
    steps: list[Inputs] = []

    def near() -> Slots:
        reach = config.engage_near_us if pilot is not None else config.engage_idle_us
        sticks = np.array(safe if pilot is None else pilot)
        return tuple(float(us) for us in sticks + rng.integers(-reach, reach + 1, 4))

    def ask(count: int, dt: float) -> list[Inputs]:
        return [(dt, near(), True, pilot) for _ in range(count)]

    while len(steps) < STEPS:
        what, n, dt = int(rng.integers(10)), int(rng.integers(3, 9)), float(rng.integers(18, 27))
        engage = bool(rng.random() < 0.5)
        if what < 2:  # silent for exactly the limit or a little less, at once or in two parts
            limit = float(config.host_timeout_ms) - float(rng.integers(2))
            first = float(rng.integers(1, 50))
            parts = [limit] if rng.random() < 0.5 else [first, limit - first]
            steps += [(part, None, engage, pilot) for part in parts]
            steps += ask(n, dt) if rng.random() < 0.6 else []
        elif what == 2:
            steps += [(dt, None, engage, pilot)] * n
        elif what == 3 and pilot is not None:  # moves a stick, by as much as counts or just not
            moved, channel = list(pilot), int(rng.integers(4))
            by_us = float(rng.choice([60.0, 120.0, 121.0, 300.0]))
            moved[channel] += by_us if moved[channel] < 1500.0 else -by_us
            pilot = tuple(moved)
            steps += [(dt, near(), engage, pilot), *ask(n, dt)]
        elif what == 4:  # another pilot's signal, or none
            pilot = None if rng.random() < 0.4 else tuple(map(float, rng.integers(1200, 1800, 4)))
            steps += [(dt, near(), False, pilot)] * int(rng.integers(2)) + ask(n, dt)
        elif what == 5:  # nearly enough commands, or one far off among them, or too slow
            steps += [(dt, near(), False, pilot), *ask(int(rng.integers(3, 5)), dt)]
            far = tuple(us + (300.0 if us < 1500.0 else -300.0) for us in near())
            steps += (
                [(dt, far, True, pilot)] if rng.random() < 0.5 else [(150.0, None, True, pilot)]
            )
            steps += ask(n, dt)
        elif what == 6:  # at the edge of the window
            slow = float(rng.choice([124.0, 125.0]))
            steps += [(dt, near(), False, pilot), *ask(6, slow)]
        else:
            steps += [(dt, near(), False, pilot)] * (rng.random() < 0.8) + ask(n, dt)
    return steps


def _same_states(student: Function, rng: np.random.Generator, config: SafetyConfig) -> bool:
    """Step by step as the model of the board's program, which sees time, pilot, then command."""
    memory: Any = {
        "state": "SAFE",
        "engage": True,
        "good": 0,
        "age_ms": 0.0,
        "edge_ms": 0.0,
        "pilot_us": None,
    }
    safety, now_us = Safety(config), 0
    for number, inputs in enumerate(_trace(rng, config)):
        dt_ms, command_us, engage, pilot_us = inputs
        now_us += round(1000.0 * dt_ms)
        safety.tick(now_us, None if pilot_us is None else [round(us) for us in pilot_us])
        if pilot_us is None:
            safety.has_pilot = False  # the board forgets a signal after 100 ms, here it is told
        if command_us is not None:
            safety.frame(now_us, number, engage, [round(us) for us in command_us])
        memory = student(memory, *inputs)
        if not isinstance(memory, dict) or memory.get("state") != safety.state:
            return False
    return True


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
