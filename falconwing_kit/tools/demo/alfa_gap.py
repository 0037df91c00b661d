"""The real flight's gap: the ALFA story -> which forces of the catalogue explain the failure, since when, how large."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from falconwing_kit.aircraft.effects import CATALOGUE, Effect
from falconwing_kit.aircraft.model import Model, record_of
from falconwing_kit.aircraft.terms import air_flow
from falconwing_kit.core.flight_table import FlightTable, slice_time
from falconwing_kit.gap.baseline import LEAST_GAIN, CalmBase, judged_base
from falconwing_kit.gap.close import Onset, find_onset
from falconwing_kit.gap.name import Candidate, fit_flight
from falconwing_kit.gap.noise import PoseNoise
from falconwing_kit.sysid.fit import FitResult, fit
from falconwing_kit.sysid.forecast import with_throttle_held
from falconwing_kit.sysid.identify import identify
from falconwing_kit.sysid.prepare import prepare
from falconwing_kit.sysid.shooting import Windows, cut_windows, pose_residuals
from falconwing_kit.sysid.uncertainty import uncertainty
from falconwing_kit.tools.demo.alfa_story import AlfaStory, alfa_facts, alfa_start, ordinary_prior

WINDOW_S = 4.0  # ten poses of this log, as in half a second of a camera's; two seconds hold five, and say little
CUTS = 4  # ways to cut the stretch into windows, a second apart
HEALTHY_S = 50.0  # before the failure that are judged with it, so that nobody tells the time
WHITE = PoseNoise((0.0, 0.0), (0.5, 0.5))  # of poses 0.4 s apart nothing is known in between


@dataclass(frozen=True)
class Suspect:
    """An effect, acting from its own best time on; the middle one of several ways to cut the stretch into windows."""

    effect: Effect
    gain: float  # evidence over the healthy model: chi2 in units of its scatter, less the price of parameters and time
    time: float  # when it set in [s]
    earliest: float  # of all cuts' 95 % intervals [s]
    latest: float
    value: float  # of its first parameter, with the middle of the 95 % intervals
    low95: float
    high95: float


@dataclass(frozen=True)
class AlfaGap:
    """What the poses say about the failure, told nothing of the engine."""

    verdict: Literal["named", "ambiguous", "none"]
    suspects: tuple[Suspect, ...]  # best first
    threshold: float  # evidence needed, from the flight before the failure
    told_gain: float  # evidence of the logged throttle alone: nothing fitted, nothing added
    begin: float  # of the stretch judged [s]
    end: float  # where a stick first leaves the range it had before the failure [s]
    before: float  # mean square residual of the windows with the failure, over that before it: healthy model
    after: float  # with the thrust loss

    @property
    def chosen(self) -> tuple[Suspect, ...]:
        """Those that the poses cannot tell from the best; none where nothing is clear."""
        near = tuple(s for s in self.suspects if s.gain > self.suspects[0].gain - LEAST_GAIN)
        return near if self.verdict != "none" else ()

    @property
    def thrust_loss(self) -> Suspect:
        """The effect that truly happened."""
        return next(s for s in self.suspects if s.effect.name == "thrust_loss")


def judge_alfa(story: AlfaStory, progress: Callable[[str], None] = lambda stage: None) -> AlfaGap:
    """Ask of every force in the catalogue from when on it explains the last minute, the throttle held as before.

    The stretch ends where a stick leaves the range that it had before the failure: what the aircraft does beyond, in
    slow flight with the elevator far up, the model was never taught. Where the windows happen to be cut moves the
    answer, since there are but a dozen: so they are cut in several ways, and the middle answer counts.

    Args:
        story: the flight, its healthy part and the failure.
        progress: called with the name of each stage.

    Returns:
        Verdict and evidence.
    """
    progress("real flight, longer windows")
    failure, start = story.failure_time, alfa_start(alfa_facts())
    healthy = [slice_time(story.table, 0.0, failure)]
    found = identify(healthy, model=start, prior=ordinary_prior(start), window_s=WINDOW_S)
    catalogue = suiting(found.model)
    windows = found.fitted_windows
    base = judged_base(found, WHITE, fit(found.model, windows, found.result.starts), windows, catalogue)
    end = _end_of_known(story.table, failure)
    threshold = max(LEAST_GAIN, 3.0 * base.false_gain)
    answers: dict[str, list[Suspect]] = {}
    others = []
    for cut in range(CUTS):
        progress(f"real flight, since when and what, cut {cut + 1} of {CUTS}")
        begin = failure - HEALTHY_S - cut * WINDOW_S / CUTS
        onsets, *rest = _judge_cut(base, catalogue, story.table, begin, end, failure)
        others.append(rest)
        for onset, suspect in onsets:
            answers.setdefault(onset.effect.name, []).append(suspect)
        catalogue = tuple(o.effect for o, _ in onsets if o.gain > threshold or o.effect.name == "thrust_loss")
    suspects = sorted((_middle(a) for a in answers.values() if len(a) == CUTS), key=lambda s: -s.gain)
    near = sum(s.gain > suspects[0].gain - LEAST_GAIN for s in suspects)
    verdict: Literal["named", "ambiguous", "none"] = "ambiguous" if near > 1 else "named"
    told, before, after = np.median(others, axis=0).tolist()
    return AlfaGap(
        verdict if suspects[0].gain > threshold else "none", tuple(suspects), threshold, told,
        failure - HEALTHY_S, end, before, after,
    )  # fmt: skip


def _judge_cut(
    base: CalmBase, catalogue: Sequence[Effect], table: FlightTable, begin: float, end: float, failure: float
) -> tuple[list[tuple[Onset, Suspect]], float, float, float]:
    """Every effect's onset in one cut; evidence of the logged throttle; residual without and with the thrust loss."""
    held = slice_time(with_throttle_held(table, failure), begin, end)
    windows, before = fit_flight(base, prepare(held, base.found.sigma))
    logged = cut_windows(prepare(slice_time(table, begin, end), base.found.sigma).flights, before.model, WINDOW_S)
    told = fit(before.model, replace(logged, weight=windows.weight), before.starts, prior=base.prior)
    late = windows.nodes[:, -1] + begin > failure
    onsets, after = [], before
    for effect in catalogue:
        unknown = Candidate(effect, 0.0, 0.0, {p.name: p.start for p in effect.parameters}, None)
        onset = find_onset(base, windows, before, [unknown])
        if onset is not None:
            onsets.append((onset, _suspect(base, windows, onset)))
            after = onset.result if effect.name == "thrust_loss" else after
    shares = [_mean_square(r, windows, late) / _mean_square(r, windows, ~late) for r in (before, after)]
    return onsets, (before.cost - told.cost) / base.scatter, shares[0], shares[1]


def _suspect(base: CalmBase, windows: Windows, onset: Onset) -> Suspect:
    name = onset.effect.parameters[0].name
    value = onset.result.model.values[name]
    low, high = uncertainty(onset.result, windows, base.prior).interval(name, value)
    return Suspect(onset.effect, onset.gain, onset.time, onset.low95, onset.high95, value, low, high)


def _middle(cuts: Sequence[Suspect]) -> Suspect:
    """The middle answer; a flap without lift is drag by another name, and has no evidence of its own."""
    effect = cuts[0].effect
    gain, time, value, low, high = (
        float(np.median([getattr(s, name) for s in cuts])) for name in ("gain", "time", "value", "low95", "high95")
    )
    if effect.parameters[0].name in effect.essential and low < 0.0 < high:
        gain = min(gain, 0.0)
    earliest, latest = min(s.earliest for s in cuts), max(s.latest for s in cuts)
    return Suspect(effect, gain, time, earliest, latest, value, low, high)


def suiting(model: Model, catalogue: Sequence[Effect] = CATALOGUE) -> tuple[Effect, ...]:
    """Effects that mean something of their own in a model with quasi-steady rates: forces without a moment.

    Its rates follow sticks and flow at once, so that a moment written as angular acceleration does not fit, and a
    moved neutral is the same as other L_0, M_0, N_0. A load that an effect does not have is a plain zero in its
    formula.

    Args:
        model: the base model.
        catalogue: the effects.

    Returns:
        Those that suit, in the catalogue's order.
    """
    one = np.ones(1)
    flow = air_flow((one, one, one), (one, one, one), (one, one, one), one, (one, one, one, one))
    chosen = []
    for effect in catalogue:
        if effect.term is None:
            continue
        full = model.with_effect(effect)
        try:
            loads = effect.term.evaluate(flow, record_of(full.names)(*full.vector))
        except AttributeError:  # it reads a parameter that this form of model does not have
            continue
        if all(type(moment) is float and moment == 0.0 for moment in loads[3:]):
            chosen.append(effect)
    return tuple(chosen)


def _end_of_known(table: FlightTable, failure: float) -> float:
    """When a stick first leaves the range it had before the failure; throttle aside, which is held."""
    sticks, healthy = table.commands[:, 1:], table.t < failure
    low, high = sticks[healthy].min(axis=0), sticks[healthy].max(axis=0)
    beyond = ~healthy & ((sticks < low) | (sticks > high)).any(axis=1)
    return float(table.t[beyond][0]) if beyond.any() else float(table.t[-1])


def _mean_square(result: FitResult, windows: Windows, which: np.ndarray) -> float:
    squares = pose_residuals(result.residual, windows)[which] ** 2
    return float(squares.sum() / np.count_nonzero(windows.weight[which]))
