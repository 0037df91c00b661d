"""Lab 10, given: your course's numbers, a faulty wire, a radio link with dropouts, video, plots."""

import json
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

HOLD_MS = COHORT["hold_ms"]  # without a valid command for so long: HOLD [ms]
LOST_MS = COHORT["lost_ms"]  # ... and for so long: LOST [ms]
ENGAGE_FRAMES = 5  # good frames in a row before the host may fly
STATES = ("SAFE", "ACTIVE", "HOLD", "LOST")
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


def switched_on() -> Memory:
    """What the safety machine remembers when the board starts."""
    return {"state": "SAFE", "armed": False, "good": 0, "age_ms": 0.0}


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


def scene_of_faults() -> list[tuple[bool, bool, bool]]:
    """Six seconds of (valid, engage, pilot moved) per frame, with two dropouts and a takeover."""
    steps = [(True, False, False)] * 10 + [(True, True, False)] * 50
    steps += [(False, False, False)] * 6 + [(True, True, False)] * 34  # a short dropout
    steps += [(False, False, False)] * 20 + [(True, True, False)] * 30  # a long one
    steps += [(True, False, False)] * 10 + [
        (True, True, False)
    ] * 60  # the host disengages and engages again
    return [*steps, (True, True, True), *[(True, True, False)] * 40]  # the pilot moves a stick


def plot_takeover(steps: list[tuple[bool, bool, bool]], states: list[str]) -> None:
    """States over time, with what the host and the pilot did below.

    Args:
        steps: (valid, engage, pilot moved) of each PPM frame.
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
        yticks=range(4),
        yticklabels=STATES,
        title="Who flies (simulated host and pilot)",
    )
    above.grid(alpha=0.3)
    rows = {"valid command": [s[0] for s in steps], "host engages": [s[1] for s in steps]}
    for row, ((name, on), colour) in enumerate(zip(rows.items(), (GREEN, ORANGE), strict=True)):
        below.fill_between(t, row, row + 0.8 * np.array(on), step="post", color=colour, alpha=0.6)
        below.text(0.02, row + 0.3, name, fontsize=8)
    for moved in t[[s[2] for s in steps]]:
        for axes in (above, below):
            axes.axvline(moved, color=PINK, ls="--")
        above.text(moved + 0.03, 2.4, "pilot moves\na stick", fontsize=8)
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
