"""Lab 10, given: your course's numbers, a faulty wire, a radio link with dropouts, video, plots."""

import binascii
import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

HERE = Path(__file__).parent
COHORT: dict[str, float] = json.loads((HERE / "cohort.json").read_text(encoding="utf-8"))

GAP_US = COHORT["gap_us"]  # width of a pulse [us]
CENTRE_US = COHORT["centre_us"]  # slot of a stick in the middle [us]
REACH_US = 500.0  # from the middle to an end of a stick [us]
FRAME_US = 22000.0  # from the first edge of a frame to the first edge of the next [us]
TICKS_PER_US = 2  # the board's timer runs at 16 MHz / 8
TIMER = 65536  # and has 16 bits: after 65535 comes 0
PAUSE_US = 4000.0  # so long between two pulses, or longer, ends a frame [us]
VALID_US = (800.0, 2200.0)  # shortest and longest slot that is one [us]

LOST_MS = COHORT["lost_ms"]  # without a valid command for so long: LOST [ms]
NEAR_US = COHORT[
    "near_us"
]  # a command this near to the pilot's sticks, or the middle, engages [us]
IDLE_US = 20.0  # and this near to idle, for the throttle where no pilot is measured [us]
MOVED_US = 120.0  # a stick of the pilot that moved by more takes over: 12 % of 1000 us [us]
ENGAGE_FRAMES = 5  # matching commands in a row before the host may fly
WINDOW_MS = 500.0  # less than this from the first of them to the last [ms]
SAFE_US = (CENTRE_US - REACH_US, CENTRE_US, CENTRE_US, CENTRE_US)  # idle, and the middle [us]
COMMAND = 0x01  # type of the message that is a command
MAX_FRAME = 64  # no frame is longer [bytes, without its zero]
RANGE_US = (900.0, 2100.0)  # a command with a slot beyond is dropped [us]
LIMITS_US = (1000.0, 2000.0)  # a slot that goes to the radio is cut to these [us]
SLEW_US = 250.0  # and changes by so much at most from one frame to the next [us]
STATES = ("SAFE", "ACTIVE", "LOST")
STICKS = ("throttle", "aileron", "elevator", "rudder")

BLOCK_PX = 8  # side of a block [px]
C1, C2 = (0.01 * 255.0) ** 2, (0.03 * 255.0) ** 2  # of SSIM, for grey levels 0..255
FROZEN_LEVELS = (
    0.5  # two pictures that differ by less on average are the same picture [grey levels]
)

BLUE, ORANGE, GREEN, PINK = (
    "#0072B2",
    "#D55E00",
    "#009E73",
    "#CC79A7",
)  # distinct for colour-blind eyes as well

Memory = dict[str, Any]
Slots = tuple[float, ...]
Step = tuple[
    Slots | None, bool, Slots | None
]  # command or None, its engage, pilot's sticks or None


def switched_on() -> Memory:
    """What the safety machine remembers when the board starts."""
    return {
        "state": "SAFE",
        "engage": True,  # so that the first command is no edge
        "good": 0,
        "age_ms": 0.0,
        "edge_ms": 0.0,
        "pilot_us": None,
    }


def crc16(data: bytes) -> int:
    """Checksum CRC-16/CCITT-FALSE, 0..65535; of b"123456789" it is 0x29B1."""
    return binascii.crc_hqx(data, 0xFFFF)


Event = tuple[float, np.ndarray | None, Slots | None]  # time [ms], bytes or None, pilot's sticks


def run_bridge(bridge: type, events: Sequence[Event]) -> dict[str, Any]:
    """A new board through a series of events; checks and grader call your class through this.

    Args:
        bridge: your class.
        events: time [ms], (n,) uint8 bytes that come then, and None; or time, None for a frame that
            begins then, and the pilot's sticks.

    Returns:
        "states": the state after each frame, by the frame's name; "slots": (frames, 4) [us].
    """
    board, states, sent = bridge(), {}, []
    for t_ms, data, pilot_us in events:
        if data is not None:
            board.receive(data.tobytes(), t_ms)
        else:
            sent.append([float(us) for us in board.frame(t_ms, pilot_us)])
            states[f"frame {len(states)}, at {t_ms:g} ms"] = board.state
    return {"states": states, "slots": np.array(sent, float)}


def first_edges(frames_us: np.ndarray, jitter_us: float = 0.0, seed: int = 0) -> np.ndarray:
    """SIMULATED: what a timer reads at the first edge of each pulse, of frames one after the other.

    Args:
        frames_us: (frames, channels) slots [us].
        jitter_us: standard deviation of each edge [us].
        seed: of the jitter.

    Returns:
        (frames (channels + 1),) ticks of half a microsecond, 0..65535, wrapped.
    """
    within = np.concatenate([np.zeros((len(frames_us), 1)), np.cumsum(frames_us, axis=1)], axis=1)
    times_us = (within + FRAME_US * np.arange(len(frames_us))[:, None]).ravel()
    times_us = times_us + jitter_us * np.random.default_rng(seed).normal(size=times_us.shape)
    return np.round(TICKS_PER_US * times_us).astype(np.int64) % TIMER


def with_faults(
    ticks: np.ndarray, seed: int, lost: float = 0.02, extra: float = 0.02
) -> np.ndarray:
    """SIMULATED: the same reading with pulses lost, and with sparks that look like pulses.

    Args:
        ticks: (n,) as `first_edges` gives them.
        seed: of the faults.
        lost: share of the pulses that are missing.
        extra: chance of a spark, for each pulse, 100 to 300 us behind it.

    Returns:
        (m,) ticks, 0..65535.
    """
    rng = np.random.default_rng(seed)
    kept = ticks[rng.random(len(ticks)) >= lost]
    edges = []
    for tick in kept:
        edges.append(tick)
        if rng.random() < extra:
            edges.append((tick + rng.integers(200, 600)) % TIMER)
    return np.array(edges, np.int64)


def video() -> tuple[np.ndarray, list[tuple[int, int, str]]]:
    """SIMULATED video of the arena at 20 Hz, and what happens in it.

    Returns:
        (n, 48, 64) uint8 grey levels; and (first, last, what) of each part, in frames.
    """
    with np.load(HERE / "data" / "video.npz", allow_pickle=False) as file:
        images, firsts, names = file["images"], file["firsts"], file["names"]
    lasts = [*firsts[1:], len(images)]
    return images, [
        (int(a), int(b), str(what)) for a, b, what in zip(firsts, lasts, names, strict=True)
    ]


def plot_frame(edges: np.ndarray, errors_us: dict[str, np.ndarray]) -> None:
    """The wire during one frame, and how far decoded slots are off.

    Args:
        edges: (2 (channels + 1),) ticks of one frame that starts at tick 0: down, up, down ...
        errors_us: for each way of making edges, the errors of many slots [us].
    """
    import matplotlib.pyplot as plt

    _, (wire, spread) = plt.subplots(
        1, 2, figsize=(11.0, 3.4), width_ratios=(3, 2), layout="constrained"
    )
    ms = np.unwrap(edges.astype(float), period=TIMER) / TICKS_PER_US / 1000.0
    levels = np.tile([0, 1], len(ms) // 2)
    wire.step([-1.0, *ms, 10.0], [1, *levels, 1], where="post", color=BLUE)
    for number, (a, b) in enumerate(zip(ms[0:-2:2], ms[2::2], strict=True), 1):
        wire.text(
            0.5 * (a + b), 1.12, f"ch {number}\n{1000.0 * (b - a):.0f} us", ha="center", fontsize=8
        )
    wire.set(xlabel="time [ms]", ylabel="level of the wire [-]", ylim=(-0.2, 1.6), yticks=(0, 1))
    wire.set_title(f"One PPM frame; the pause lasts until {FRAME_US / 1000.0:g} ms")
    for (name, errors), colour, line in zip(
        errors_us.items(), (BLUE, ORANGE), ("-", "--"), strict=False
    ):
        label = f"{name}: sd {np.std(errors):.1f} us"
        spread.hist(
            errors,
            bins=np.arange(-25.25, 25.5, 0.5),
            histtype="step",
            color=colour,
            ls=line,
            label=label,
        )
    spread.set(
        xlabel="error of a slot [us]", ylabel="slots [-]", yscale="log", title="Timing (simulated)"
    )
    spread.legend(fontsize=8)


def scene_of_faults() -> list[Step]:
    """Six seconds, frame by frame: two dropouts, a host that asks with the wrong throttle, a
    takeover.
    """
    pilot = (SAFE_US[0] + 540.0, SAFE_US[1] + 20.0, SAFE_US[2] - 60.0, SAFE_US[3])
    flown = (pilot[0] + 40.0, pilot[1] - 30.0, pilot[2] + 10.0, pilot[3])
    wrong = (pilot[0] + 400.0, *flown[1:])
    moved = (*pilot[:3], pilot[3] + 150.0)
    none, off, on = (None, False, pilot), (flown, False, pilot), (flown, True, pilot)
    steps = [off] * 10 + [on] * 50
    steps += [none] * 6 + [on] * 34  # a short dropout
    steps += [none] * 20 + [on] * 30  # a long one
    steps += [off] * 10 + [(wrong, True, pilot)] * 20  # asks with the wrong throttle
    steps += [off] * 10 + [on] * 50
    return [*steps, *[(flown, True, moved)] * 40]  # the pilot moves a stick


def board_states(steps: list[Step]) -> list[str]:
    """The states of the kit's model of the board's program after each of these steps, one a frame,
    with this course's numbers.
    """
    from falconwing_kit.trainer_port import Safety

    safety, states = Safety(_board_config()), []
    for number, (command_us, engage, pilot_us) in enumerate(steps):
        now_us = round(number * FRAME_US)
        safety.tick(now_us, None if pilot_us is None else [round(us) for us in pilot_us])
        if command_us is not None:
            safety.frame(now_us, number, engage, [round(us) for us in command_us])
        states.append(safety.state)
    return states


def _board_config() -> Any:
    """Settings of the kit's model of the board, with this course's numbers."""
    from falconwing_kit.trainer_port import SafetyConfig

    return SafetyConfig(
        safe_us=(*(int(us) for us in SAFE_US), 1500, 1500, 1500, 1500),
        host_timeout_ms=int(LOST_MS),
        engage_near_us=int(NEAR_US),
    )


def bytes_of_faults(flipped: float = 1.0 / 300.0, seed: int = 10) -> list[Event]:
    """SIMULATED: the scene of faults on the serial line, with bits flipped and bytes in pieces.

    Args:
        flipped: chance of each bit.
        seed: of the flips and cuts.
    """
    from falconwing_kit.trainer_port import encode_channels

    rng, events = np.random.default_rng(seed), []
    for number, (command_us, engage, pilot_us) in enumerate(scene_of_faults()):
        t_ms = 22.0 * number
        events.append((t_ms, None, pilot_us))
        if command_us is None:
            continue
        frame = encode_channels(number, [int(us) for us in command_us], engage)
        bits = np.unpackbits(np.frombuffer(frame, np.uint8))
        data = np.packbits(bits ^ (rng.random(len(bits)) < flipped))
        while len(data):
            t_ms, count = t_ms + 0.5, int(rng.integers(1, 10))
            events.append((t_ms, data[:count], None))
            data = data[count:]
    return events


def kit_bridge() -> Any:
    """The kit's reader of frames and its model of the board, with the methods of your class."""
    from falconwing_kit.trainer_port import CommandFrame, Deframer, Safety

    class KitBridge:
        def __init__(self) -> None:
            self.reader, self.safety, self.state = Deframer(), Safety(_board_config()), "SAFE"

        def receive(self, new: bytes, t_ms: float) -> None:
            for message in self.reader.feed(new):
                if isinstance(message, CommandFrame):
                    now_us, slots = round(1000.0 * t_ms), message.channels_us
                    self.safety.frame(now_us, message.sequence, message.engage, slots)
            self.state = self.safety.state

        def frame(self, t_ms: float, pilot_us: Slots | None) -> tuple[float, ...]:
            pilot = None if pilot_us is None else [round(us) for us in pilot_us]
            slots = self.safety.tick(round(1000.0 * t_ms), pilot)
            self.state = self.safety.state
            return tuple(float(us) for us in slots or ())

    return KitBridge


def plot_takeover(steps: list[Step], states: list[str]) -> None:
    """States over time, with what the host and the pilot did below.

    Args:
        steps: command, engage and pilot's sticks of each PPM frame.
        states: the state after each.
    """
    import matplotlib.pyplot as plt

    _, (above, below) = plt.subplots(
        2, 1, figsize=(11.0, 4.4), sharex=True, height_ratios=(2, 1), layout="constrained"
    )
    t = np.arange(len(states)) * FRAME_US * 1e-6
    above.step(t, [STATES.index(state) for state in states], where="post", color=BLUE)
    above.set(
        ylabel="state",
        yticks=range(len(STATES)),
        yticklabels=STATES,
        title="Who flies (simulated host and pilot)",
    )
    above.grid(alpha=0.3)
    near = [a is None or b is None or abs(a[0] - b[0]) <= NEAR_US for a, _, b in steps]
    rows = {
        "valid command": [command is not None for command, _, _ in steps],
        "host engages": [engage for _, engage, _ in steps],
        "throttle near the pilot's": near,
    }
    for row, ((name, on), colour) in enumerate(
        zip(rows.items(), (GREEN, ORANGE, BLUE), strict=True)
    ):
        below.fill_between(t, row, row + 0.8 * np.array(on), step="post", color=colour, alpha=0.6)
        below.text(0.02, row + 0.3, name, fontsize=8)
    first = steps[0][2]
    moved = next(
        t[k]
        for k, (_, _, pilot_us) in enumerate(steps)
        if pilot_us is not None and pilot_us != first
    )
    for axes in (above, below):
        axes.axvline(moved, color=PINK, ls="--")
    above.text(moved + 0.03, 1.6, "pilot moves\na stick", fontsize=8)
    below.set(xlabel="time [s]", ylabel="on or off", yticks=[])


def plot_monitor(
    ssim: np.ndarray, alarm: np.ndarray, parts: list[tuple[int, int, str]], threshold: float
) -> None:
    """SSIM and alarms along the video.

    Args:
        ssim: (n - 1,) of each pair of pictures.
        alarm: (n - 1,) 0 no alarm, 1 noise, 2 frozen.
        parts: as `video` gives them.
        threshold: of the rule.
    """
    import matplotlib.pyplot as plt

    _, axes = plt.subplots(figsize=(11.0, 3.4), layout="constrained")
    t = 0.05 * np.arange(1, len(ssim) + 1)
    axes.plot(t, ssim, color=BLUE, label="SSIM to the picture before")
    axes.axhline(threshold, color="black", ls=":", label=f"threshold {threshold:g}")
    for code, colour, marker, name in (
        (1, ORANGE, "x", "alarm: noise"),
        (2, PINK, "s", "alarm: frozen"),
    ):
        axes.plot(
            t[alarm == code],
            np.full((alarm == code).sum(), 1.06),
            marker,
            color=colour,
            ms=5,
            label=name,
        )
    for first, last, what in parts:
        axes.axvline(0.05 * first, color="0.7", lw=0.8)
        axes.text(0.025 * (first + last), -0.13, what, ha="center", fontsize=8)
    axes.set(
        xlabel="time [s]",
        ylabel="SSIM [-]",
        ylim=(-0.2, 1.15),
        title="Frame monitor on simulated video, 20 Hz",
    )
    axes.legend(fontsize=8, loc="center left", bbox_to_anchor=(1.0, 0.5))


def moving_wire(count: int = 80) -> Any:
    """A film: the sticks move, and the pulses of each frame with them, as on an oscilloscope.

    Args:
        count: of the pictures.
    """
    from matplotlib.figure import Figure

    from falconwing_kit.tools.grading import moving_figure

    figure = Figure(figsize=(8.4, 3.8), layout="constrained")
    axes: Any = figure.subplots(2, 1, height_ratios=(1.0, 1.3))
    bars, wire = axes
    shown = bars.barh(STICKS, np.zeros(4), color=(GREEN, BLUE, ORANGE, PINK))
    bars.set(xlim=(-1.05, 1.05), xlabel="stick [-]")
    bars.invert_yaxis()
    line = wire.step([], [], where="post", color=BLUE)[0]
    texts = [wire.text(0.0, 1.12, "", ha="center", fontsize=8) for _ in STICKS]
    wire.set(
        xlabel="time [ms]", ylabel="wire [-]", xlim=(-0.5, 10.0), ylim=(-0.2, 1.6), yticks=(0, 1)
    )

    def draw(number: int) -> None:
        turn = 2.0 * np.pi * number / count
        sticks = np.array([0.5 - 0.5 * np.cos(turn), *(0.9 * np.sin([turn, 2 * turn, 3 * turn]))])
        reach = np.array([2.0 * sticks[0] - 1.0, *sticks[1:]])
        starts_ms = np.concatenate([[0.0], np.cumsum(CENTRE_US + REACH_US * reach)]) / 1000.0
        for bar, value in zip(shown, sticks, strict=True):
            bar.set_width(value)
        edges = np.column_stack([starts_ms, starts_ms + GAP_US / 1000.0]).ravel()
        line.set_data([-0.5, *edges, 10.0], [1, *([0, 1] * 5), 1])
        for text, a, b in zip(texts, starts_ms[:-1], starts_ms[1:], strict=True):
            text.set_position((0.5 * (a + b), 1.12))
            text.set_text(f"{1000.0 * (b - a):.0f} us")
        bars.set_title("Four sticks, and the frame that carries them (simulated)", fontsize=9)

    words = "Four bars swing; below, five short pulses move apart and together with them."
    return moving_figure(figure, draw, count, 0.1, words)
