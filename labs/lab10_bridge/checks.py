"""Lab 10: its exercises, what a student can check, and what a person grades."""

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
from given import (
    CENTRE_US,
    COMMAND,
    ENGAGE_FRAMES,
    GAP_US,
    IDLE_US,
    LOST_MS,
    MOVED_US,
    NEAR_US,
    SAFE_US,
    WINDOW_MS,
    Slots,
    crc16,
    switched_on,
)

from falconwing_kit.tools.grading import Check, Criterion, Exercise, Function, Lab, is_same_answer
from falconwing_kit.trainer_port import encode_channels

LEVEL = {"throttle": 0.5, "aileron": 0.0, "elevator": 0.0, "rudder": 0.0}


def _slots_us(encode: Function, order: str = "TAER", **sticks: float) -> list[float]:
    edges = np.asarray(encode({**LEVEL, **sticks}, order, 0), float)
    return [float(us) for us in np.diff(edges[::2]) % 65536 / 2.0]


def _ppm(*frames: tuple[float, ...], first: int = 60000, pause: float = 10000.0) -> np.ndarray:
    """Ticks of the first edges of frames, with one lone pulse before and behind."""
    gaps = [pause] + [gap for slots in frames for gap in (*slots, pause)]
    return (first + np.concatenate([[0], np.cumsum(2.0 * np.array(gaps))])).astype(int) % 65536


def _decodes(decode: Function, ticks: np.ndarray, *expected: tuple[float, ...]) -> bool:
    return is_same_answer(decode(ticks, 4), np.array(expected, float).reshape(-1, 4), 0.0, 1e-9)


Inputs = tuple[float, Slots | None, bool, Slots | None]
PILOT = (SAFE_US[0] + 540.0, SAFE_US[1] + 20.0, SAFE_US[2] - 60.0, SAFE_US[3])
FLOWN = (PILOT[0] + 30.0, PILOT[1], PILOT[2], PILOT[3] - 40.0)


def _after(step: Function, *inputs: Inputs) -> dict:
    memory = switched_on()
    for each in inputs:
        memory = step(memory, *each)
    return memory


def _on(slots: Slots = FLOWN, pilot: Slots | None = PILOT, dt_ms: float = 22.0) -> Inputs:
    return (dt_ms, slots, True, pilot)


OFF, ON = (22.0, FLOWN, False, PILOT), _on()
FLYING = (OFF, *[ON] * ENGAGE_FRAMES)


def _silence(ms: float) -> Inputs:
    return (ms, None, True, PILOT)


def _moved(slots: Slots, channel: int, by_us: float) -> Slots:
    return tuple(us + by_us * (k == channel) for k, us in enumerate(slots))


def _is(step: Function, state: str, *inputs: Inputs) -> bool:
    return bool(_after(step, *inputs)["state"] == state)


def _keeps_argument(step: Function) -> bool:
    memory = switched_on()
    step(memory, *OFF)
    return memory == switched_on()


def _flat(*levels: int) -> np.ndarray:
    return np.stack([np.full((16, 24), level, np.uint8) for level in levels])


def _boards(*signs: int) -> np.ndarray:
    board = np.indices((16, 24)).sum(axis=0) % 2
    return np.stack([np.where(board, 125 + 25 * sign, 125 - 25 * sign) for sign in signs]).astype(
        np.uint8
    )


def _alarms(monitor: Function, images: np.ndarray, count: int, *expected: int) -> bool:
    return is_same_answer(monitor(images, 0.7, count)[1], np.array(expected))


def _half_and_half(monitor: Function) -> bool:
    """Half of the blocks the same, half flat and brighter: the mean of 1 and 0.92309."""
    images = _flat(100, 100)
    images[1, :, 8:16], images[1, :8, :8] = 150, 150
    return is_same_answer(
        monitor(images, 0.7, 5)[0], np.array([0.5 * (1.0 + 30006.5025 / 32506.5025)])
    )


ENCODE = (
    Check(
        "sticks in the middle and half throttle: four slots of CENTRE_US, "
        "the first edge at start_tick",
        lambda f: (
            is_same_answer(_slots_us(f), [CENTRE_US] * 4, 0.0, 1e-6)
            and int(np.asarray(f(LEVEL, "TAER", 700))[0]) == 700
        ),
        "Each slot lasts from the start of one pulse to the start of the next; "
        "two ticks are a microsecond.",
    ),
    Check(
        "the throttle at 0, 1/4 and 1 gives CENTRE_US - 500, - 250 and + 500 us",
        lambda f: is_same_answer(
            [_slots_us(f, throttle=t)[0] - CENTRE_US for t in (0.0, 0.25, 1.0)],
            [-500.0, -250.0, 500.0],
            0.0,
            1e-6,
        ),
        "The throttle has no middle: map 0..1 to -1..1 first.",
    ),
    Check(
        "a positive stick makes a longer slot: aileron 0.2 gives 100 us more, in its own slot only",
        lambda f: is_same_answer(
            _slots_us(f, aileron=0.2),
            [CENTRE_US, CENTRE_US + 100.0, CENTRE_US, CENTRE_US],
            0.0,
            1e-6,
        ),
        "Look at the order of the slots and at the sign.",
    ),
    Check(
        'the order is obeyed: with "AETR" the throttle is in slot 3 and the rudder in slot 4',
        lambda f: is_same_answer(
            [
                us - CENTRE_US
                for us in _slots_us(f, "AETR", throttle=0.0, aileron=1.0, elevator=-1.0, rudder=0.5)
            ],
            [500.0, -500.0, -500.0, 250.0],
            0.0,
            1e-6,
        ),
        "Go through the letters of `order`, not through the sticks.",
    ),
    Check(
        "the pulses are GAP_US wide, ten edges in all, down and up in turn",
        lambda f: is_same_answer(
            np.asarray(f(LEVEL, "TAER", 0), float)[1::2] - f(LEVEL, "TAER", 0)[::2],
            np.full(5, 2 * GAP_US),
        ),
        "Five pulses: the last one only ends channel 4. Widths are in ticks, too.",
    ),
    Check(
        "slots are whole microseconds, rounded: aileron 0.0307 is 15 us, and 0.0313 is 16 us",
        lambda f: is_same_answer(
            [_slots_us(f, aileron=a)[1] - CENTRE_US for a in (0.0307, 0.0313, -0.0313)],
            [15.0, 16.0, -16.0],
            0.0,
            1e-6,
        ),
        "Round each slot, to the nearest microsecond; do not cut the decimals off, "
        "and do not round ticks.",
    ),
    Check(
        "a stick beyond its end is cut to its end; a throttle below 0 is idle",
        lambda f: is_same_answer(
            [us - CENTRE_US for us in _slots_us(f, throttle=-0.7, aileron=3.0, elevator=-1.4)],
            [-500.0, 500.0, -500.0, 0.0],
            0.0,
            1e-6,
        ),
        "Cut every stick to its own limits, before anything else.",
    ),
    Check(
        "a stick that is not a number makes the whole command safe: throttle 0, "
        "the others in the middle",
        lambda f: is_same_answer(
            _slots_us(f, throttle=0.9, aileron=0.5, rudder=float("nan")),
            [CENTRE_US - 500.0, *[CENTRE_US] * 3],
            0.0,
        ),
        "Use numpy.isfinite; it is not enough to replace the one stick.",
    ),
    Check(
        "counts are 0..65535: a frame that starts at 60000 wraps, with the same slots",
        lambda f: is_same_answer(
            np.asarray(f(LEVEL, "TAER", 60000)) - (np.asarray(f(LEVEL, "TAER", 0)) + 60000) % 65536,
            np.zeros(10),
        ),
        "Behind 65535 comes 0, so the remainder by 65536.",
    ),
)
DECODE = (
    Check(
        "two clean frames come out as they went in, in microseconds, although the timer wraps",
        lambda f: _decodes(
            f,
            _ppm((1100, 1500, 1900, 1501), (1000, 2000, 1500, 1400)),
            (1100, 1500, 1900, 1501),
            (1000, 2000, 1500, 1400),
        ),
        "Differences of wrapped counts: take the remainder by 65536. Two ticks are a microsecond.",
    ),
    Check(
        "half a microsecond is not lost: a slot of 1500.5 us stays one",
        lambda f: _decodes(f, _ppm((1500.5, 1200, 1300, 1400)), (1500.5, 1200, 1300, 1400)),
        "Do not divide as whole numbers.",
    ),
    Check(
        "a frame cut off at the beginning or at the end of the reading is left out",
        lambda f: (
            _decodes(
                f,
                _ppm((1100, 1200, 1300, 1400), (1500, 1600, 1700, 1800))[3:],
                (1500, 1600, 1700, 1800),
            )
            and _decodes(
                f,
                _ppm((1100, 1200, 1300, 1400), (1500, 1600, 1700, 1800))[:-1],
                (1100, 1200, 1300, 1400),
            )
        ),
        "A frame stands between two pauses, and you must have seen both.",
    ),
    Check(
        "a frame with a slot too few or too many is left out, and the next one is read",
        lambda f: (
            _decodes(
                f, _ppm((1100, 1200, 1300), (1500, 1600, 1700, 1800)), (1500, 1600, 1700, 1800)
            )
            and _decodes(
                f,
                _ppm((1100, 1200, 1300, 900, 1000), (1500, 1600, 1700, 1800)),
                (1500, 1600, 1700, 1800),
            )
        ),
        "Count the slots between the pauses.",
    ),
    Check(
        "slots of 800 and 2200 us are good; 799.5, 2200.5 and 3000 us are not",
        lambda f: (
            _decodes(f, _ppm((800, 2200, 1500, 1500)), (800, 2200, 1500, 1500))
            and _decodes(
                f,
                _ppm(
                    (1500, 799.5, 1500, 1500), (2200.5, 1500, 1500, 1500), (1500, 1500, 1500, 3000)
                ),
            )
        ),
        "Compare all slots of a frame with both limits; a limit itself is still good.",
    ),
    Check(
        "a pause of exactly 4000 us is a pause",
        lambda f: _decodes(
            f, _ppm((1100, 1200, 1300, 1400), pause=4000.0), (1100, 1200, 1300, 1400)
        ),
        "PAUSE_US or more.",
    ),
    Check(
        "no good frame gives an array of shape (0, channels), "
        "and six channels work as well as four",
        lambda f: (
            is_same_answer(f(_ppm((1100, 1200)), 4), np.zeros((0, 4)))
            and is_same_answer(
                f(_ppm((1100, 1200, 1300, 1400, 1500, 1600)), 6),
                np.array([[1100.0, 1200, 1300, 1400, 1500, 1600]]),
            )
        ),
        "Look at numpy.reshape(-1, channels).",
    ),
)
MATCHES = (
    Check(
        "the pilot's own sticks match, and full throttle against them does not",
        lambda f: bool(f(PILOT, PILOT)) and not f(_moved(PILOT, 0, 460.0), PILOT),
        "Compare each slot with the pilot's.",
    ),
    Check(
        "every slot counts, up and down: NEAR_US away still matches, 1 us more does not",
        lambda f: all(
            bool(f(_moved(PILOT, k, sign * NEAR_US), PILOT))
            and not f(_moved(PILOT, k, sign * (NEAR_US + 1.0)), PILOT)
            for k in range(4)
            for sign in (-1.0, 1.0)
        ),
        "Take the absolute difference of each of the four slots; the limit itself matches.",
    ),
    Check(
        "idle does not match against a pilot who flies",
        lambda f: not f(SAFE_US, PILOT),
        "SAFE_US counts only where no pilot is measured.",
    ),
    Check(
        "without a pilot idle and middle match; a throttle 1 us more than IDLE_US above does not",
        lambda f: (
            bool(f(SAFE_US, None))
            and bool(f(_moved(SAFE_US, 0, IDLE_US), None))
            and not f(_moved(SAFE_US, 0, IDLE_US + 1.0), None)
        ),
        "The first slot has its own limit where no pilot is measured.",
    ),
    Check(
        "without a pilot the other slots may be NEAR_US from the middle, and no more",
        lambda f: all(
            bool(f(_moved(SAFE_US, k, -NEAR_US), None))
            and not f(_moved(SAFE_US, k, -NEAR_US - 1.0), None)
            for k in (1, 2, 3)
        ),
        "IDLE_US is the throttle's alone.",
    ),
)
FAILSAFE = (
    Check(
        "off, then five matching commands with engage on: ACTIVE at the fifth, not before",
        lambda f: _is(f, "SAFE", *FLYING[:-1]) and _is(f, "ACTIVE", *FLYING),
        "Rule 5: the edge counts as the first.",
    ),
    Check(
        "a host that has engage on from the start never flies: it must let go first",
        lambda f: _is(f, "SAFE", *[ON] * 12),
        "Rule 5: without an edge `good` stays 0.",
    ),
    Check(
        "a frame without a command between them does no harm; a silence of LOST_MS does",
        lambda f: (
            _is(f, "ACTIVE", OFF, ON, ON, _silence(22.0), ON, ON, ON)
            and _is(f, "SAFE", OFF, ON, ON, _silence(LOST_MS), ON, ON, ON, ON)
        ),
        "Rule 3: `good` = 0 once the age is LOST_MS.",
    ),
    Check(
        "the five must come within WINDOW_MS of the edge",
        lambda f: (
            _is(f, "ACTIVE", OFF, *[_on(dt_ms=WINDOW_MS / 4.0 - 1.0)] * 5)
            and _is(f, "SAFE", OFF, *[_on(dt_ms=WINDOW_MS / 4.0)] * 9)
        ),
        "Rule 5: `edge_ms` is 0 at the edge and grows with every step; less than WINDOW_MS counts.",
    ),
    Check(
        "one command that does not match ends the count, until there is a new edge",
        lambda f: (
            _is(f, "SAFE", OFF, ON, ON, _on(_moved(FLOWN, 0, 400.0)), *[ON] * 9)
            and _is(f, "SAFE", OFF, _on(SAFE_US), *[ON] * 9)
            and _is(f, "ACTIVE", OFF, _on(SAFE_US), *FLYING)
        ),
        "Rule 5: `good` = 0, at the edge as well.",
    ),
    Check(
        "in ACTIVE a command need not match: the host flies",
        lambda f: _is(f, "ACTIVE", *FLYING, *[_on(_moved(FLOWN, 1, 400.0))] * 5),
        "Rule 5 is for SAFE only.",
    ),
    Check(
        "silence shorter than LOST_MS stays ACTIVE, of LOST_MS it is LOST, "
        "and commands alone do not bring it back",
        lambda f: (
            _is(f, "ACTIVE", *FLYING, _silence(LOST_MS - 1.0))
            and _is(f, "LOST", *FLYING, _silence(LOST_MS))
            and _is(f, "LOST", *FLYING, _silence(LOST_MS - 1.0), _silence(1.0))
            and _is(f, "LOST", *FLYING, _silence(LOST_MS), *[ON] * 9)
        ),
        "The age grows with dt_ms, and a limit counts when it is reached.",
    ),
    Check(
        "two silences with a command between them are not one long silence",
        lambda f: _is(f, "ACTIVE", *FLYING, _silence(0.6 * LOST_MS), ON, _silence(0.6 * LOST_MS)),
        "Rule 6: a valid command sets the age to 0.",
    ),
    Check(
        "engage off is SAFE in the same step, from ACTIVE and LOST; "
        "off and five commands later the host flies again",
        lambda f: (
            _is(f, "SAFE", *FLYING, OFF)
            and _is(f, "SAFE", *FLYING, _silence(LOST_MS), OFF)
            and _is(f, "ACTIVE", *FLYING, _silence(LOST_MS), *FLYING)
        ),
        "Rule 4 does not ask for the state.",
    ),
    Check(
        "a stick of the pilot that moves by more than MOVED_US is SAFE in the same step, "
        "whatever the host sends",
        lambda f: all(
            _is(f, "SAFE", *FLYING, _on(pilot=_moved(PILOT, k, sign * (MOVED_US + 1.0))))
            and _is(f, "SAFE", *FLYING, (22.0, None, True, _moved(PILOT, k, 300.0 * sign)))
            and _is(f, "ACTIVE", *FLYING, _on(pilot=_moved(PILOT, k, sign * MOVED_US)))
            for k in range(4)
            for sign in (-1.0, 1.0)
        ),
        "Rule 2: any of the four, up or down.",
    ),
    Check(
        "a stick that moves slowly has moved: it is compared with where it was at the engagement",
        lambda f: _is(
            f, "SAFE", *FLYING, *[_on(pilot=_moved(PILOT, 3, 30.0 * k)) for k in range(1, 6)]
        ),
        "Do not change `pilot_us` in ACTIVE once it is known.",
    ),
    Check(
        "after the takeover the host must let go, and then ask near the sticks as they are now",
        lambda f: (
            _is(f, "SAFE", *FLYING, *[_on(pilot=_moved(PILOT, 0, -300.0))] * 12)
            and _is(f, "SAFE", *FLYING, *[(i[0], i[1], i[2], SAFE_US) for i in FLYING])
            and _is(
                f,
                "ACTIVE",
                *FLYING,
                _on(pilot=SAFE_US),
                (22.0, SAFE_US, False, SAFE_US),
                *[_on(SAFE_US, SAFE_US)] * 5,
            )
        ),
        "Rule 2 changes the state, and `engage` stays on: there is no edge.",
    ),
    Check(
        "engaged without a pilot, the first sticks that are measured are where they are",
        lambda f: (
            _is(f, "ACTIVE", (22.0, SAFE_US, False, None), *[_on(SAFE_US, None)] * 5, ON)
            and _is(
                f,
                "SAFE",
                (22.0, SAFE_US, False, None),
                *[_on(SAFE_US, None)] * 5,
                ON,
                _on(pilot=_moved(PILOT, 2, 121.0)),
            )
        ),
        "Rule 2: remember them if `pilot_us` is None.",
    ),
    Check(
        "engage means nothing without a valid command",
        lambda f: (
            _is(f, "ACTIVE", *FLYING, (10.0, None, False, PILOT))
            and _is(f, "SAFE", (9.0, None, False, PILOT), *[ON] * 9)
        ),
        "Ask for the command first.",
    ),
    Check("the memory that comes in stays as it is", _keeps_argument, "Return a new dictionary."),
)
MONITOR = (
    Check(
        "the same picture twice has SSIM 1",
        lambda f: is_same_answer(f(_boards(1, 1, 1), 0.7, 5)[0], np.ones(2)),
        "Numerator and denominator must then be equal.",
    ),
    Check(
        "flat grey 100 and flat grey 150: by hand 30006.5025 / 32506.5025 = 0.92309",
        lambda f: is_same_answer(
            f(_flat(100, 150), 0.7, 5)[0], np.array([30006.5025 / 32506.5025])
        ),
        "With no variance the second factor is 1. 200 + 100 in uint8 is 44: turn into float first.",
    ),
    Check(
        "a chequered board of 100 and 150 and its negative: "
        "by hand -1191.4775 / 1308.5225 = -0.91055",
        lambda f: is_same_answer(f(_boards(1, -1), 0.7, 5)[0], np.array([-1191.4775 / 1308.5225])),
        "Variance is 625: divide by the number of pixels, 64. The covariance is negative here.",
    ),
    Check(
        "the picture's value is the mean of its blocks': half of them 1 and half 0.92309",
        _half_and_half,
        "Formula per block first, mean last. Look at the order of axes in reshape.",
    ),
    Check(
        "with count = 3 the noise alarm comes at the third bad pair and ends with the first good "
        "one",
        lambda f: _alarms(f, _boards(1, -1, 1, -1, 1, 1, 1), 3, 0, 0, 1, 1, 0, 0),
        "All of the last `count` pairs; before that many were seen there is no alarm.",
    ),
    Check(
        "with count = 2 the frozen alarm comes at the second pair that does not change",
        lambda f: _alarms(f, _flat(10, 10, 10, 60, 60, 60), 2, 0, 2, 0, 0, 2),
        "Code 2, by the mean absolute difference.",
    ),
    Check(
        "a change of half a level or more, up or down, is not frozen",
        lambda f: (
            _alarms(
                f,
                np.where(np.arange(24) % 2, 1, 0) * np.array([0, 1, 0, 1])[:, None, None]
                + _flat(90, 90, 90, 90),
                2,
                0,
                0,
                0,
            )
            and _alarms(f, _boards(1, -1, 1), 2, 0, 1)
        ),
        "The absolute difference: ups and downs must not cancel.",
    ),
    Check(
        "the threshold counts: the same pictures are noise with 0.95 and are not with 0.9",
        lambda f: (
            is_same_answer(f(_flat(100, 150, 100), 0.95, 2)[1], np.array([0, 1]))
            and is_same_answer(f(_flat(100, 150, 100), 0.9, 2)[1], np.array([0, 0]))
        ),
        "Use the argument, not 0.7.",
    ),
)

Item = bytes | list[bytes] | None  # bytes in one piece, in several, or none
HELD = tuple(float(round(us)) for us in FLOWN)


def _sent(slots: Slots = HELD, engage: bool = True, sequence: int = 0) -> bytes:
    return encode_channels(sequence, [round(us) for us in slots], engage)


def _series(*commands: tuple[Slots, bool], first: int = 7) -> list[Item]:
    """Commands one after the other, with sequences that grow."""
    return [_sent(slots, on, (first + k) % 65536) for k, (slots, on) in enumerate(commands)]


OFF_THEN_ON = _series((HELD, False), *[(HELD, True)] * ENGAGE_FRAMES)


def _frames(
    bridge: Function, *items: Item, pilots: Sequence[Slots | None] = ()
) -> list[tuple[Any, ...]]:
    """State and slots of each frame: one at 0 ms, then 22 ms each, with an item 1 ms behind it."""
    events: list[tuple[float, np.ndarray | None, Slots | None]] = []
    for number, item in enumerate((*items, None)):
        t_ms = 22.0 * number
        events.append((t_ms, None, pilots[number] if number < len(pilots) else PILOT))
        pieces = item if isinstance(item, list) else [item] if item is not None else []
        for piece in pieces:
            t_ms += 1.0
            events.append((t_ms, np.frombuffer(piece, np.uint8), None))
    answer = bridge(events)
    states, slots = answer["states"].values(), answer["slots"]
    return [(state, *map(float, row)) for state, row in zip(states, slots, strict=True)]


def _states(bridge: Function, *items: Item, pilots: Sequence[Slots | None] = ()) -> str:
    """First letters of the states, frame by frame."""
    return "".join(str(frame[0])[:1] for frame in _frames(bridge, *items, pilots=pilots))


def _pieces(data: bytes, size: int) -> list[bytes]:
    return [data[i : i + size] for i in range(0, len(data), size)]


def _engages_through(bridge: Function, *noise: bytes, places: Sequence[int] = range(6)) -> bool:
    """Whether commands with noise in front of these are all read."""
    items = [
        b"".join(noise) + item if k in places and isinstance(item, bytes) else item
        for k, item in enumerate(OFF_THEN_ON)
    ]
    return _states(bridge, *items) == "SSSSSSA"


def _damaged(frame: bytes, at: int, by: int) -> bytes:
    return frame[:at] + bytes([frame[at] ^ by]) + frame[at + 1 :]


def _drops(bridge: Function, *wrong: bytes) -> bool:
    """Whether each of these in the place of the fifth command leaves the board at four."""
    good = [item for item in OFF_THEN_ON if isinstance(item, bytes)]
    return all(
        _states(bridge, *good[:5], each) == "SSSSSSS"
        and _states(bridge, *good[:5], each, good[5]) == "SSSSSSSA"
        for each in wrong
    )


def _packed(payload: bytes) -> bytes:
    """A frame of any payload, by the text's rules."""
    content = payload + crc16(payload).to_bytes(2, "little")
    return b"".join(bytes([len(run) + 1]) + run for run in content.split(b"\0")) + b"\0"


def _payload(flags: int, sequence: int = 12, slots: Slots = HELD, kind: int = COMMAND) -> bytes:
    tail = b"".join(round(us).to_bytes(2, "little") for us in slots)
    return bytes([kind]) + sequence.to_bytes(2, "little") + bytes([flags]) + tail


def _slots_after(bridge: Function, slots: Slots, frames: int) -> tuple[Any, ...]:
    """The last frame after the board is ACTIVE and a command is repeated for so many frames."""
    commands = [(HELD, False), *[(HELD, True)] * (ENGAGE_FRAMES + 6), *[(slots, True)] * frames]
    return _frames(bridge, *_series(*commands))[-1]


TOO_FAR = (2200.0, *HELD[1:])
SILENT_FRAMES = math.ceil((LOST_MS - 21.0) / 22.0)  # in ACTIVE after the frame behind a command
BRIDGE = (
    Check(
        "a board that nobody speaks to is SAFE and sends SAFE_US",
        lambda f: _frames(f, None, None) == [("SAFE", *SAFE_US)] * 3,
        "`frame` returns four slots in every state.",
    ),
    Check(
        "off and five commands with engage on, each in one piece: ACTIVE in the frame after",
        lambda f: _states(f, *OFF_THEN_ON) == "SSSSSSA",
        "Cut at the zero byte, undo COBS, compare the CRC of the payload (without its last two "
        "bytes), then a step of `failsafe_state`.",
    ),
    Check(
        "the same byte by byte, and in pieces of 7 that do not end with the frames",
        lambda f: (
            _states(f, *[_pieces(item, 1) for item in OFF_THEN_ON]) == "SSSSSSA"
            and _states(f, *[_pieces(item, 7) for item in OFF_THEN_ON]) == "SSSSSSA"
        ),
        "Keep the bytes behind the last zero until the next call.",
    ),
    Check(
        "all six commands in one piece are six steps",
        lambda f: _states(f, b"".join(OFF_THEN_ON), None) == "SAA",
        "A piece may hold several frames: go through all of them.",
    ),
    Check(
        "noise, an empty frame, or half a frame before a frame costs nothing if a zero ends it",
        lambda f: (
            _engages_through(f, b"\0")
            and _engages_through(f, b"\x05\x01\xff\x00")
            and _engages_through(f, _sent(HELD, True, 3)[:9], b"\0")
        ),
        "Whatever the bytes before it were, the next zero ends them; an empty frame is no error.",
    ),
    Check(
        "a frame with a flipped bit, a byte too few or too many is dropped, the next one is read",
        lambda f: _drops(
            f,
            *[_damaged(OFF_THEN_ON[5], at, 0x10) for at in range(len(OFF_THEN_ON[5]) - 1)],
            OFF_THEN_ON[5][:6] + OFF_THEN_ON[5][7:],
            OFF_THEN_ON[5][:6] + b"\x31" + OFF_THEN_ON[5][6:],
            b"\xff\x01\0",
            b"\x02\x01\0",
        ),
        "Look at the CRC, and at lengths of COBS that lead beyond the end; nothing may raise.",
    ),
    Check(
        "another type, three or five slots, and a longer payload are dropped, although whole",
        lambda f: _drops(
            f,
            _packed(_payload(1, kind=0x02)),
            _packed(_payload(1, slots=HELD[:3])),
            _packed(_payload(1, slots=(*HELD, 1500.0))),
            _packed(_payload(1) + b"\x07"),
            _packed(b"\x01"),
        ),
        "The payload of a command has 12 bytes, and begins with COMMAND.",
    ),
    Check(
        "slots of 899 or 2101 us make a command invalid; 900 and 2100 us do not",
        lambda f: (
            all(
                _drops(f, _packed(_payload(1, slots=(*HELD[:k], us, *HELD[k + 1 :]))))
                for k, us in ((0, 899.0), (0, 2101.0), (3, 899.0), (3, 2101.0))
            )
            and all(
                _slots_after(f, (us, *HELD[1:]), 6)[:2] == ("ACTIVE", cut)
                for us, cut in ((900.0, 1000.0), (2100.0, 2000.0))
            )
        ),
        "RANGE_US decides whether a command counts; LIMITS_US cuts what goes to the radio.",
    ),
    Check(
        "a sequence that came before, or is older, is dropped; 0 after 65535 is new",
        lambda f: (
            _drops(f, _packed(_payload(1, sequence=11)), _packed(_payload(1, sequence=2)))
            and _states(f, *_series((HELD, False), *[(HELD, True)] * ENGAGE_FRAMES, first=65533))
            == "SSSSSSA"
        ),
        "The difference modulo 65536, between 1 and 32767.",
    ),
    Check(
        "a sequence 32767 ahead is new, 32768 ahead is not; a dropped one changes nothing",
        lambda f: (
            _states(f, *OFF_THEN_ON[:5], _packed(_payload(1, sequence=11 + 32767))) == "SSSSSSA"
            and _drops(f, _packed(_payload(1, sequence=11 + 32768)))
            and _drops(f, _packed(_payload(1, sequence=500, slots=(800.0, *HELD[1:]))))
        ),
        "Only a valid command is remembered as the last one.",
    ),
    Check(
        "engage is bit 0 of the flags: 3 is on, 2 is off",
        lambda f: (
            _states(f, *OFF_THEN_ON[:5], _packed(_payload(3))) == "SSSSSSA"
            and _states(f, *OFF_THEN_ON, _packed(_payload(2, sequence=13))) == "SSSSSSAS"
        ),
        "Mask the bit: flags & 1.",
    ),
    Check(
        "in ACTIVE the slots go to the command by SLEW_US a frame at most, and stay there",
        lambda f: (
            [frame[1:] for frame in _frames(f, *_series((HELD, False), *[(HELD, True)] * 8))[6:]]
            == [
                (SAFE_US[0] + 250.0, *HELD[1:]),
                (SAFE_US[0] + 500.0, *HELD[1:]),
                HELD,
                HELD,
            ]
            and _slots_after(f, (HELD[0], HELD[1] - 300.0, *HELD[2:]), 1)[2] == HELD[1] - 250.0
            and _slots_after(f, (HELD[0], HELD[1] - 300.0, *HELD[2:]), 2)[2] == HELD[1] - 300.0
        ),
        "Each slot is compared with the same slot of the frame before, SAFE_US included.",
    ),
    Check(
        "after the last command the board goes on for less than LOST_MS, then LOST and SAFE_US",
        lambda f: (
            _states(f, *OFF_THEN_ON, *[None] * SILENT_FRAMES)
            == "SSSSSS" + "A" * SILENT_FRAMES + "L"
            and _frames(f, *OFF_THEN_ON, *[None] * SILENT_FRAMES)[-1] == ("LOST", *SAFE_US)
        ),
        "Every frame is a step of the machine, with the time since the last step.",
    ),
    Check(
        "commands that are dropped do not keep the board ACTIVE",
        lambda f: (
            _states(f, *OFF_THEN_ON, *[OFF_THEN_ON[-1]] * 14)[-1] == "L"
            and _states(f, *OFF_THEN_ON, *[_damaged(_sent(HELD, True, 40), 5, 4)] * 14)[-1] == "L"
            and _states(f, *OFF_THEN_ON, *[_sent(TOO_FAR, True, 40), *[None] * 4] * 3)[-1] == "L"
        ),
        "A step with a command only for a valid one.",
    ),
    Check(
        "the pilot moves a stick: SAFE and SAFE_US in that very frame",
        lambda f: (
            _frames(
                f,
                *OFF_THEN_ON,
                _sent(HELD, True, 13),
                pilots=[PILOT] * 7 + [_moved(PILOT, 2, MOVED_US + 1.0)],
            )[6:]
            == [
                ("ACTIVE", SAFE_US[0] + 250.0, *HELD[1:]),
                ("SAFE", *SAFE_US),
            ]
        ),
        "Give the machine this frame's sticks, before you choose the slots.",
    ),
    Check(
        "a command is compared with the pilot's sticks of the last frame, measured or not",
        lambda f: (
            _states(f, *OFF_THEN_ON, pilots=[None] * 7) == "SSSSSSS"
            and _states(f, *OFF_THEN_ON, pilots=[PILOT] * 2 + [None] * 5) == "SSSSSSS"
            and _states(f, *_series((SAFE_US, False), *[(SAFE_US, True)] * 5), pilots=[None] * 7)
            == "SSSSSSA"
        ),
        "Keep `pilot_us` of the last frame for the commands that come after it.",
    ),
)

LAB = Lab(
    name="lab10",
    title="Trainer-port bridge",
    hours=4.0,
    exercises=(
        Exercise("encode_ppm", 12.0, ENCODE),
        Exercise("decode_ppm", 12.0, DECODE),
        Exercise("matches", 5.0, MATCHES),
        Exercise("failsafe_state", 14.0, FAILSAFE),
        Exercise("TrainerBridge", 20.0, BRIDGE, through="run_bridge", nearby=False, free=True),
        Exercise("ssim_monitor", 12.0, MONITOR),
    ),
    rubric=(
        Criterion("timing", 2.0, "Five pulses, slots labelled; both histograms."),
        Criterion(
            "timing_reading",
            3.0,
            "Two edges, root of two, 5.7 us; the timer needs the program only beforehand.",
        ),
        Criterion(
            "takeover",
            5.0,
            "SAFE in the very frame of the pilot's stick; LOST stays until the host lets go.",
        ),
        Criterion(
            "monitor",
            5.0,
            "Names the false alarm in the turn and the silence of SSIM on the frozen picture.",
        ),
        Criterion(
            "q1", 3.0, "Both sides: jerks against an old command; 7 m/s times LOST_MS, 14 m in 2 s."
        ),
        Criterion(
            "q2", 4.0, "The pilot has control; coming back must be a person's deliberate act."
        ),
        Criterion("q3", 3.0, "False alarm by motion; blind to frozen; a fix for each."),
    ),
    constants={
        "gap_us": (300.0, 450.0, 0),
        "centre_us": (1470.0, 1540.0, 0),
        "near_us": (80.0, 120.0, 0),
        "lost_ms": (180.0, 260.0, 0),
    },
)
