"""Lab 10, hidden: the cases and their references, independent of the lab's solution."""

import binascii
import math
from collections.abc import Mapping
from functools import partial
from typing import Any

import numpy as np

from falconwing_kit.tools.grading import Course, Function, Judge, Trials, Values
from falconwing_kit.trainer_port import (
    CommandFrame,
    Deframer,
    Safety,
    SafetyConfig,
    Stick,
    encode_channels,
    encode_sync,
)

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
        "TrainerBridge": tuple(
            Values(
                partial(_line_events, kind=kind, config=config),
                partial(_by_the_kit, config=config),
                cases=3,
                rtol=0.0,
            )
            for kind in LINES
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


LINES = ("pieces", "noise", "invalid", "who flies")  # what goes wrong on the serial line


def _by_the_kit(events: Any, config: SafetyConfig) -> dict[str, Any]:
    """The kit's reader of frames, and its model of the board's program."""
    reader, safety, states, slots = Deframer(), Safety(config), {}, []
    for t_ms, data, pilot_us in events:
        now_us = round(1000.0 * t_ms)
        if data is None:
            slots.append(
                safety.tick(now_us, None if pilot_us is None else list(map(round, pilot_us)))
            )
            if pilot_us is None:
                safety.has_pilot = False  # the board forgets a signal after 100 ms, here it is told
            states[f"frame {len(states)}, at {t_ms:g} ms"] = safety.state
            continue
        for message in reader.feed(data.tobytes()):
            if isinstance(message, CommandFrame):
                safety.frame(now_us, message.sequence, message.engage, message.channels_us)
    return {"states": states, "slots": np.array(slots, float)}


def _line_events(rng: np.random.Generator, kind: str, config: SafetyConfig) -> tuple[Any, ...]:
    """A board's life of some seconds in which the host flies for a while.

    Drawn again where it never flies, or where five commands out of range make a FAULT.
    """
    while True:
        events = _drawn_events(rng, kind, config)
        states = list(_by_the_kit(events, config)["states"].values())
        if 5 <= states.count("ACTIVE") < len(states) - 5 and "FAULT" not in states:
            return (events,)


def _drawn_events(rng: np.random.Generator, kind: str, config: SafetyConfig) -> list[Any]:
    safe = tuple(float(us) for us in config.safe_us[:4])
    pilot: Slots | None = safe if rng.random() < 0.4 else tuple(map(float, _sticks_near(rng, safe)))
    if rng.random() < 0.2:
        pilot = None
    sequence = int(rng.integers(65500, 65536)) if rng.random() < 0.5 else int(rng.integers(65536))
    flown, wrong, t_ms = safe, 0, 0.0
    events: list[Any] = [(0.0, None, pilot)]
    part = np.zeros(0, np.uint8)  # bytes that are still on their way
    for phase in _phases(rng, kind):
        count = int(rng.integers(6, 12)) if phase != "silence" else int(rng.integers(3, 16))
        count = 15 if kind == "invalid" and phase == "silence" else count
        if kind == "who flies" and rng.random() < 0.3:  # the pilot's signal stops, or comes back
            near = tuple(map(float, _sticks_near(rng, safe)))
            pilot = near if pilot is None else None
        for number in range(count):
            t_frame = t_ms + float(rng.choice([21.5, 22.0, 22.5]))
            sent = b""
            if phase == "off" or (phase == "on" and number == 0 and rng.random() < 0.6):
                sent = _command(rng, sequence := sequence + 1, flown, False)
            elif phase in ("on", "moves"):
                near = safe if pilot is None else pilot
                flown = near if number < 6 else _steered(rng, flown)
                sent = _command(rng, sequence := sequence + 1, flown, True)
            if sent and kind == "noise":
                sent = _noisy(rng, sent)
            if kind == "invalid" and (number % 3 == 0 if phase == "silence" else number % 3 == 1):
                far = (phase == "silence" and wrong < 4) or rng.random() < 0.15
                other, is_wrong = _invalid(rng, sequence, flown, far)
                sent, wrong = sent + other, wrong + is_wrong
            if phase == "moves" and number == 3 and pilot is not None:
                moved = np.array(pilot)
                moved[int(rng.integers(4))] += float(rng.choice([-121.0, -120.0, 120.0, 121.0]))
                pilot = tuple(map(float, moved))
            part = np.concatenate([part, np.frombuffer(sent, np.uint8)])
            whole = kind == "who flies" or rng.random() < 0.4
            for at in np.sort(rng.integers(1, 42, 1 if whole else 4)) / 2.0:
                size = len(part) if whole else int(rng.integers(0, len(part) + 1))
                if size:
                    events.append((t_ms + float(at), part[:size].copy(), None))
                part = part[size:]
            t_ms = t_frame
            events.append((t_ms, None, pilot))
    return _without_late_commands(events, config)


def _phases(rng: np.random.Generator, kind: str) -> list[str]:
    """What the host and the pilot do one after the other."""
    middle = ["on", "silence", "on", "off", "on", "moves", "on"]
    some = [str(each) for each in rng.permutation(middle)[: int(rng.integers(3, 6))]]
    some = ["silence", *some] if kind == "invalid" else some
    return ["off", "on", *some, *(["off", "on", "moves"] if kind == "who flies" else [])]


def _command(
    rng: np.random.Generator, sequence: int, slots: Slots, engage: bool, kind: int = 0x01
) -> bytes:
    """A frame whose other flags are off, or on and off by chance."""
    flags = 2 * int(rng.integers(128)) * int(rng.integers(2)) + engage
    payload = bytes([kind]) + (sequence % 65536).to_bytes(2, "little") + bytes([flags])
    payload += b"".join(round(us).to_bytes(2, "little") for us in slots)
    content = payload + binascii.crc_hqx(payload, 0xFFFF).to_bytes(2, "little")
    return b"".join(bytes([len(run) + 1]) + run for run in content.split(b"\0")) + b"\0"


def _sticks_near(rng: np.random.Generator, safe: Slots) -> np.ndarray:
    away = [int(rng.integers(100, 800)), *rng.integers(-200, 201, 3)]
    return np.array(safe) + np.array(away)


def _steered(rng: np.random.Generator, slots: Slots) -> Slots:
    """Another command, now and then far away or beyond the radio's limits."""
    away = rng.choice([20, 150, 600]) * rng.uniform(-1.0, 1.0, 4)
    return tuple(float(us) for us in np.clip(np.round(np.array(slots) + away), 900.0, 2100.0))


def _noisy(rng: np.random.Generator, frame: bytes) -> bytes:
    """The frame as it is, with a bit flipped, a byte lost or added, or noise in front of it."""
    what, at = int(rng.integers(7)), int(rng.integers(len(frame)))
    if what in (0, 5):
        return frame[:at] + bytes([frame[at] ^ (1 << int(rng.integers(8)))]) + frame[at + 1 :]
    if what == 1:
        return frame[:at] + frame[at + 1 :]
    if what == 2:
        return frame[:at] + rng.bytes(1) + frame[at:]
    if what == 3:
        return rng.bytes(int(rng.integers(1, 90))) + b"\0" + frame
    return frame if what == 6 else b"\0" + frame


def _invalid(
    rng: np.random.Generator, sequence: int, slots: Slots, is_out_of_range: bool
) -> tuple[bytes, bool]:
    """A whole frame that is no valid command, and whether a slot of it is out of range."""
    what, on = int(rng.integers(8)), bool(rng.random() < 0.8)
    if what == 5:
        kind = int(rng.choice([0x02, 0x03, 0x11]))
        return _command(rng, sequence + 1, (1500.0,) * 4, on, kind), False
    if is_out_of_range:
        wrong = [round(us) for us in slots]
        wrong[int(rng.integers(4))] = int(rng.choice([0, 899, 2101, 65535]))
        return encode_channels(sequence + 1, wrong, on), True
    if what in (0, 1, 6):
        old = sequence - int(rng.choice([0, 0, 0, 1, 8]))
        return encode_channels(old % 65536, [1500] * 4, on), False
    if what in (2, 7):
        return encode_channels(sequence + 32768, [1500] * 4, on), False
    if what == 3:
        return encode_sync(int(rng.integers(2**32))), False
    return encode_channels(sequence + 1, [1500] * int(rng.integers(5, 9)), on), False


def _without_late_commands(events: list[Any], config: SafetyConfig) -> list[Any]:
    """Bytes that come when silence ends the flight before the next frame are moved behind it."""
    reader, safety, kept, held = Deframer(), Safety(config), [], np.zeros(0, np.uint8)
    valid_us: int | None = None
    limit_us = 1000 * config.host_timeout_ms
    seen_us = 0  # of the last frame
    for t_ms, data, pilot_us in events:
        now_us = round(1000.0 * t_ms)
        if data is None:
            kept.append((t_ms, None, pilot_us))
            safety.tick(now_us)
            seen_us = now_us
            continue
        held = np.concatenate([held, data])
        late = valid_us is not None and seen_us - valid_us < limit_us <= now_us - valid_us
        if late:
            continue  # they come with the next bytes, behind a frame
        for message in reader.feed(held.tobytes()):
            if isinstance(message, CommandFrame):
                decision = safety.frame(
                    now_us, message.sequence, message.engage, message.channels_us
                )
                valid_us = now_us if decision == 0 else valid_us
        kept.append((t_ms, held, None))
        held = np.zeros(0, np.uint8)
    return kept


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
