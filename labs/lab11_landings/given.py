"""Lab 11, given: the two tables of landings, normal quantiles, your course's number, the figure."""

import csv
import json
import math
from pathlib import Path
from statistics import NormalDist
from typing import Any

import numpy as np

COHORT: dict[str, float] = json.loads(
    (Path(__file__).parent / "cohort.json").read_text(encoding="utf-8")
)
DATA = Path(__file__).parent / "data"

BLUE, ORANGE, GREEN = (
    "#0072B2",
    "#D55E00",
    "#009E73",
)  # distinguishable for colour-blind readers (Okabe and Ito)


def z_value(confidence: float) -> float:
    """Half width of the central interval of a normal distribution, in sigmas: 0.95 gives 1.96."""
    return NormalDist().inv_cdf(0.5 + 0.5 * confidence)


def read_paper() -> dict[str, np.ndarray]:
    """The paper's table of landings: run, sim_expert_cm, sim_vision_cm, real_vision_cm, each (10,).

    Nan: not landed.
    """
    return _columns("landings.csv")


def read_simulated() -> dict[str, np.ndarray]:
    """A hundred simulated landings of the kit's expert: trial, success, ald_cm, each (100,)."""
    return _columns("kit_expert_simulated.csv")


def fly_landings(parts: Any, trials: int = 100) -> dict[str, np.ndarray]:
    """SIMULATED landings by your lab 7, from starts drawn as in the paper; as `read_simulated`.

    Args:
        parts: yours or the kit's.
        trials: how many.
    """
    import importlib

    from falconwing_kit.aircraft import LandingPad, load_airframe, rates_model
    from falconwing_kit.core import Command
    from falconwing_kit.flight import SimulatedWorld, Spread

    lab07, expert = importlib.import_module(f"{parts.__name__}.given.lab07"), parts.expert
    model, airframe, pad = rates_model(), load_airframe(), LandingPad()
    spread = Spread(position=0.4, angle=math.radians(4.0), speed=0.4)
    begin, line = (lab07.PAD_START - 20.0, lab07.AIM[1], 1.5), (lab07.AIM - (40.0, 0.0), lab07.AIM)
    success, ald_cm = np.zeros(trials), np.full(trials, np.nan)
    for trial in range(trials):
        start = spread.start(model, begin, trial)
        world = SimulatedWorld(model, airframe, start, seed=trial, pad=pad)
        autopilot, integral, idle = lab07.Autopilot(), 0.0, False
        while world.t < 20.0 and world.contact is None:
            state = world.measured()
            p, speed = state.p_world, float(np.linalg.norm(state.v_world))
            bank = expert.guidance(p[:2], state.v_world[:2], *line, 0.5 * lab07.BANK_LIMIT)
            height = p[2] - lab07.PAD_HEIGHT - lab07.WHEELS_BELOW
            climb_rate, flaring = expert.flare(height, lab07.AIM[0] - p[0], speed)
            error = lab07.SPEED - speed
            throttle, integral = expert.hold_speed(error, integral, lab07.GLIDE_THROTTLE)
            idle = idle or bool(flaring)
            rates = expert.turn_rates(bank, state.pitch, speed)
            sticks = autopilot.sticks(state, bank, climb_rate, rates)
            world.send(world.t, Command.clip(0.0 if idle else throttle, *sticks))
            world.advance(world.t + lab07.STEP)
        touch = world.contact.touchdown if world.contact else None
        if touch is not None and touch.surface == "pad":
            success[trial], ald_cm[trial] = 1.0, 100.0 * touch.absolute_lateral_deviation
    return {"trial": np.arange(trials) + 1.0, "success": success, "ald_cm": ald_cm}


def _columns(name: str) -> dict[str, np.ndarray]:
    with open(DATA / name, newline="", encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    return {key: np.array([float(row[key] or "nan") for row in rows]) for key in rows[0]}


def simple_interval(successes: float, trials: float, confidence: float) -> tuple[float, float]:
    """The formula of most first courses: share +- z sqrt(share (1 - share) / n), cut at 0 and 1."""
    share = successes / trials
    half = z_value(confidence) * math.sqrt(share * (1.0 - share) / trials)
    return max(share - half, 0.0), min(share + half, 1.0)


def coverage(interval: Any, rates: np.ndarray, trials: int, confidence: float) -> np.ndarray:
    """Exact coverage probability of an interval, over all binomial outcomes of the trials.

    Args:
        interval: a function (successes, trials, confidence) -> (low, high).
        rates: (n,) true success rates.
        trials: in each experiment.
        confidence: what the interval promises.

    Returns:
        (n,) shares.
    """
    held = np.zeros(len(rates))
    for successes in range(trials + 1):
        low, high = interval(successes, trials, confidence)
        chance = (
            math.comb(trials, successes) * rates**successes * (1.0 - rates) ** (trials - successes)
        )
        held += chance * ((low <= rates) & (rates <= high))
    return held


def draw_landings(
    table: dict[str, np.ndarray], intervals: dict[str, tuple[int, int, float, float]]
) -> None:
    """Deviation of every run, simulated and real, and success rates with their intervals.

    Args:
        table: as `read_paper` gives it.
        intervals: for each row from top to bottom: successes, trials, low and high end of the rate.
    """
    import matplotlib.pyplot as plt

    fig: Any = plt.figure(figsize=(9, 7), layout="constrained")
    runs, rates = fig.subplots(2, 1, height_ratios=(3, 2))
    simulated, real, run = table["sim_vision_cm"], table["real_vision_cm"], table["run"]
    runs.vlines(run, simulated, real, color="0.6", linewidth=1)
    runs.plot(run, simulated, "o", mfc="white", color=BLUE, label="simulated, vision")
    runs.plot(run, real, "s", color=ORANGE, label="real, vision")
    lost = np.isnan(real)
    runs.plot(
        run[lost],
        np.full(lost.sum(), 106.0),
        "x",
        color=ORANGE,
        markersize=10,
        label="real, not landed: no value",
    )
    for value, line, what in (
        (np.nanmean(real), "-", "mean of the real landings"),
        (np.nansum(real) / len(real), ":", "failures counted as 0 cm"),
    ):
        runs.axhline(value, color=ORANGE, linestyle=line, label=f"{what}: {value:.1f} cm")
    runs.axhline(100.0, color="black", linewidth=1)
    runs.text(0.6, 101.0, "edge of the pad", va="bottom")
    runs.set(
        xlabel="run",
        ylabel="absolute lateral deviation [cm]",
        xticks=run,
        xlim=(0.5, 10.5),
        ylim=(0, 112),
    )
    runs.legend(loc="upper left", bbox_to_anchor=(1.0, 1.0), fontsize="small")
    for row, (name, (good, trials, low, high)) in enumerate(intervals.items()):
        colour = ORANGE if name.startswith("real") else BLUE
        rates.plot([low, high], [row, row], color=colour, linewidth=3)
        rates.plot(good / trials, row, "s" if name.startswith("real") else "o", color=colour)
        rates.text(low - 0.01, row, f"{name}: {good} of {trials} ", ha="right", va="center")
    rates.set(
        xlabel="success rate with its interval",
        xlim=(0.0, 1.02),
        yticks=[],
        ylim=(len(intervals) - 0.5, -0.5),
    )


def moving_tens(rate: float = 0.8) -> Any:
    """A film: ten landings again and again by a pilot of known rate, and what is counted.

    SIMULATED by drawing lots: each landing succeeds with the probability `rate`.
    """
    from matplotlib.figure import Figure

    from falconwing_kit.tools.grading import moving_figure

    landed = np.random.default_rng(11).random((60, 10)) < rate
    figure = Figure(figsize=(7.2, 4.2), layout="constrained")
    ten, all_of_them = figure.subplots(2, 1, height_ratios=(1.0, 3.0))
    ten.set(xlim=(0.3, 10.7), ylim=(-1.0, 1.0), yticks=[], xticks=range(1, 11), xlabel="landing")
    good = ten.plot([], [], "o", color=BLUE, markersize=14)[0]
    bad = ten.plot([], [], "x", color=ORANGE, markersize=14, markeredgewidth=3)[0]
    bars = all_of_them.bar(range(11), np.zeros(11), color=BLUE)
    all_of_them.set(xlabel="landed of ten", ylabel="how often", ylim=(0, 22), xticks=range(11))

    def draw(number: int) -> None:
        now, run = landed[number], np.arange(1, 11)
        good.set_data(run[now], np.zeros(now.sum()))
        bad.set_data(run[~now], np.zeros((~now).sum()))
        counts = np.bincount(landed[: number + 1].sum(axis=1), minlength=11)
        for each, (bar, count) in enumerate(zip(bars, counts, strict=True)):
            bar.set_height(count)
            bar.set_color(ORANGE if each == now.sum() else BLUE)
        ten.set_title(
            f"Always the same pilot, who lands {rate:.0%}: this time {now.sum()} of 10", fontsize=10
        )

    words = "Rows of ten marks change; bars below grow to a hill from 5 to 10, highest near 8."
    return moving_figure(figure, draw, len(landed), 0.3, words)
