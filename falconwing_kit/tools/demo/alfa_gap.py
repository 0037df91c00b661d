"""The real flight's gap: the ALFA story -> which forces of the catalogue explain the failure, since
when, how large.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from falconwing_kit.aircraft.effect import Effect
from falconwing_kit.aircraft.effects import CATALOGUE
from falconwing_kit.aircraft.model import Model, parameter_record
from falconwing_kit.aircraft.terms import air_flow
from falconwing_kit.core.flight_table import FlightTable, slice_time
from falconwing_kit.gap.baseline import VERY_STRONG_EVIDENCE, NominalModel, calibrate_nominal_model
from falconwing_kit.gap.close import Onset, find_onset
from falconwing_kit.gap.name import EffectCandidate, fit_flight
from falconwing_kit.gap.noise import PoseNoiseModel
from falconwing_kit.sysid.fit import FitResult, fit
from falconwing_kit.sysid.forecast import hold_throttle
from falconwing_kit.sysid.identify import identify
from falconwing_kit.sysid.prepare import prepare
from falconwing_kit.sysid.shooting import Windows, cut_windows, pose_residuals
from falconwing_kit.sysid.uncertainty import uncertainty
from falconwing_kit.tools.demo.alfa_story import (
    AlfaAnalysis,
    alfa_initial_model,
    nominal_prior,
    read_alfa_metadata,
)

# ten poses of this log, as in half a second of a camera's; two seconds hold five, and say little
WINDOW_S = 4.0
WINDOW_OFFSETS = 4  # ways to cut the stretch into windows, a second apart
NOMINAL_S = 50.0  # before the failure that are judged with it, so that nobody tells the time
WHITE_NOISE = PoseNoiseModel(
    (0.0, 0.0), (0.5, 0.5)
)  # of poses 0.4 s apart nothing is known in between


@dataclass(frozen=True)
class OnsetHypothesis:
    """An effect, acting from its own best time on; the middle one of several ways to cut the
    stretch into windows.
    """

    effect: Effect
    # evidence over the healthy model: chi2 in units of its scatter, less the price of parameters
    # and time
    delta_bic: float
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
    hypotheses: tuple[OnsetHypothesis, ...]  # best first
    threshold: float  # evidence needed, from the flight before the failure
    logged_throttle_gain: (
        float  # evidence of the logged throttle alone: nothing fitted, nothing added
    )
    begin: float  # of the stretch judged [s]
    end: float  # where a stick first leaves the range it had before the failure [s]
    # mean square residual of the windows with the failure, over that before it: healthy model
    before: float
    after: float  # with the thrust loss

    @property
    def chosen(self) -> tuple[OnsetHypothesis, ...]:
        """Those that the poses cannot tell from the best; none where nothing is clear."""
        near = tuple(
            s
            for s in self.hypotheses
            if s.delta_bic > self.hypotheses[0].delta_bic - VERY_STRONG_EVIDENCE
        )
        return near if self.verdict != "none" else ()

    @property
    def thrust_loss(self) -> OnsetHypothesis:
        """The effect that truly happened."""
        return next(s for s in self.hypotheses if s.effect.name == "thrust_loss")


def study_alfa_gap(
    story: AlfaAnalysis, progress: Callable[[str], None] = lambda stage: None
) -> AlfaGap:
    """Ask of every force in the catalogue from when on it explains the last minute, the throttle
    held as before.

    The stretch ends where a stick leaves the range that it had before the failure: what the
        aircraft does beyond, in
    slow flight with the elevator far up, the model was never taught. Where the windows happen to be
    cut moves the answer, since there are but a dozen: so they are cut in several ways, and the
    middle answer counts.

    Args:
        story: the flight, its healthy part and the failure.
        progress: called with the name of each stage.

    Returns:
        Verdict and evidence.
    """
    progress("real flight, longer windows")
    failure, start = story.failure_time, alfa_initial_model(read_alfa_metadata())
    healthy = [slice_time(story.table, 0.0, failure)]
    found = identify(healthy, model=start, prior=nominal_prior(start), window_s=WINDOW_S)
    catalogue = applicable_effects(found.model)
    windows = found.fitted_windows
    base = calibrate_nominal_model(
        found,
        WHITE_NOISE,
        fit(found.model, windows, found.result.initial_states),
        windows,
        catalogue,
    )
    end = _input_range_exit(story.table, failure)
    threshold = max(VERY_STRONG_EVIDENCE, 3.0 * base.false_alarm_level)
    answers: dict[str, list[OnsetHypothesis]] = {}
    others = []
    for cut in range(WINDOW_OFFSETS):
        progress(f"real flight, since when and what, cut {cut + 1} of {WINDOW_OFFSETS}")
        begin = failure - NOMINAL_S - cut * WINDOW_S / WINDOW_OFFSETS
        onsets, *rest = _analyse_offset(base, catalogue, story.table, begin, end, failure)
        others.append(rest)
        for onset, hypothesis in onsets:
            answers.setdefault(onset.effect.name, []).append(hypothesis)
        catalogue = tuple(
            o.effect for o, _ in onsets if o.delta_bic > threshold or o.effect.name == "thrust_loss"
        )
    hypotheses = sorted(
        (_median_hypothesis(a) for a in answers.values() if len(a) == WINDOW_OFFSETS),
        key=lambda s: -s.delta_bic,
    )
    near = sum(s.delta_bic > hypotheses[0].delta_bic - VERY_STRONG_EVIDENCE for s in hypotheses)
    verdict: Literal["named", "ambiguous", "none"] = "ambiguous" if near > 1 else "named"
    logged_fit, before, after = np.median(others, axis=0).tolist()
    return AlfaGap(
        verdict if hypotheses[0].delta_bic > threshold else "none", tuple(hypotheses), threshold, logged_fit,
        failure - NOMINAL_S, end, before, after,
    )  # fmt: skip


def _analyse_offset(
    base: NominalModel,
    catalogue: Sequence[Effect],
    table: FlightTable,
    begin: float,
    end: float,
    failure: float,
) -> tuple[list[tuple[Onset, OnsetHypothesis]], float, float, float]:
    """Every effect's onset in one cut; evidence of the logged throttle; residual without and with
    the thrust loss.
    """
    fixed_throttle_table = slice_time(hold_throttle(table, failure), begin, end)
    windows, before = fit_flight(base, prepare(fixed_throttle_table, base.found.sigma))
    logged = cut_windows(
        prepare(slice_time(table, begin, end), base.found.sigma).flights, before.model, WINDOW_S
    )
    logged_fit = fit(
        before.model,
        replace(logged, weight=windows.weight),
        before.initial_states,
        prior=base.prior,
    )
    late = windows.nodes[:, -1] + begin > failure
    onsets, after = [], before
    for effect in catalogue:
        unknown = EffectCandidate(
            effect, 0.0, 0.0, {p.name: p.start for p in effect.parameters}, None
        )
        onset = find_onset(base, windows, before, [unknown])
        if onset is not None:
            onsets.append((onset, _build_hypothesis(base, windows, onset)))
            after = onset.result if effect.name == "thrust_loss" else after
    shares = [
        _mean_square(r, windows, late) / _mean_square(r, windows, ~late) for r in (before, after)
    ]
    return onsets, (before.cost - logged_fit.cost) / base.reduced_chi2, shares[0], shares[1]


def _build_hypothesis(base: NominalModel, windows: Windows, onset: Onset) -> OnsetHypothesis:
    name = onset.effect.parameters[0].name
    value = onset.result.model.values[name]
    low, high = uncertainty(onset.result, windows, base.prior).interval(name, value)
    return OnsetHypothesis(
        onset.effect, onset.delta_bic, onset.time, onset.low95, onset.high95, value, low, high
    )


def _median_hypothesis(cuts: Sequence[OnsetHypothesis]) -> OnsetHypothesis:
    """The middle answer; a flap without lift is drag by another name, and has no evidence of its
    own.
    """
    effect = cuts[0].effect
    delta_bic, time, value, low, high = (
        float(np.median([getattr(s, name) for s in cuts]))
        for name in ("delta_bic", "time", "value", "low95", "high95")
    )
    if effect.parameters[0].name in effect.essential and low < 0.0 < high:
        delta_bic = min(delta_bic, 0.0)
    earliest, latest = min(s.earliest for s in cuts), max(s.latest for s in cuts)
    return OnsetHypothesis(effect, delta_bic, time, earliest, latest, value, low, high)


def applicable_effects(model: Model, catalogue: Sequence[Effect] = CATALOGUE) -> tuple[Effect, ...]:
    """Effects that mean something of their own in a model with quasi-steady rates: forces without a
    moment.

    Its rates follow sticks and flow at once, so that a moment written as angular acceleration does
    not fit, and a moved neutral is the same as other L_0, M_0, N_0. A load that an effect does not
    have is a plain zero in its formula.

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
        full, term = model.with_effect(effect), effect.term(model.terms)
        if term is None:
            continue
        try:
            loads = term.evaluate(flow, parameter_record(full.names)(*full.vector))
        except AttributeError:  # it reads a parameter that this form of model does not have
            continue
        if all(type(moment) is float and moment == 0.0 for moment in loads[3:]):
            chosen.append(effect)
    return tuple(chosen)


def _input_range_exit(table: FlightTable, failure: float) -> float:
    """When a stick first leaves the range it had before the failure; throttle aside, which is held."""
    inputs, healthy = table.commands[:, 1:], table.t < failure
    low, high = inputs[healthy].min(axis=0), inputs[healthy].max(axis=0)
    beyond = ~healthy & ((inputs < low) | (inputs > high)).any(axis=1)
    return float(table.t[beyond][0]) if beyond.any() else float(table.t[-1])


def _mean_square(result: FitResult, windows: Windows, which: np.ndarray) -> float:
    squares = pose_residuals(result.residual, windows)[which] ** 2
    return float(squares.sum() / np.count_nonzero(windows.weight[which]))
