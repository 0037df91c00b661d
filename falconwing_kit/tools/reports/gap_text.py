"""A gap study -> the sentences and table rows of its page."""

import math
import re
from collections.abc import Mapping
from typing import Any

import numpy as np
from markupsafe import Markup, escape

from falconwing_kit.aircraft.effect import Effect
from falconwing_kit.aircraft.terms import Parameter
from falconwing_kit.gap.baseline import VERY_STRONG_EVIDENCE, bic_penalty
from falconwing_kit.gap.close import ParameterEstimate
from falconwing_kit.gap.measure import VARIABLES, ResidualBin
from falconwing_kit.gap.name import EffectCandidate
from falconwing_kit.gap.study import GapStudy
from falconwing_kit.sysid.score import DIVERGED_RESIDUAL, PredictionScore
from falconwing_kit.sysid.shooting import Windows, pose_residuals
from falconwing_kit.tools.reports.gap_plots import CHANNEL_WORDS, IN_PLOTS, NoiseFloor, gap_scores
from falconwing_kit.tools.reports.gap_traces import TraceWindow

GREEK = {"alpha": "α", "beta": "β"}
SMALLEST_GAP = 0.05  # chi2 above the calm flight's: of less, a share closed means nothing


# Numbers and equations


def quantity(value: float, unit: str) -> str:
    """A number of three digits with its unit, as in "0.437 m/s", "0.0123/m" or "0.2"."""
    number = _number(value)
    if unit in ("", "-"):
        return number
    return number + (unit[1:] if unit.startswith("1/") else f" {unit}")


def _number(value: float) -> str:
    return f"{value:.3g}".replace("-", "−")


def equation(text: str) -> Markup:
    """A plain equation as HTML: arrow, minus, powers, Greek letters, single-letter indices."""
    html = str(escape(text)).replace("-&gt;", "→").replace(" - ", " − ")
    html = html.replace("(-", "(−")
    html = re.sub(r"\^(\w)", r"<sup>\1</sup>", html)
    html = re.sub(r"\b([A-Z])_([a-z])\b", r"\1<sub>\2</sub>", html)
    return Markup(re.sub(r"\b(alpha|beta)\b", lambda found: GREEK[found[1]], html))


def effect_equations(effect: Effect, sizes: Mapping[str, ParameterEstimate]) -> list[Markup]:
    """The equation of an effect with symbols, then with its numbers; empty where it has none."""
    if not effect.equation:
        return []
    html, names = equation(effect.equation), [p.name for p in effect.parameters]
    shown = [html.format(**{name: name for name in names})]
    if names and all(name in sizes for name in names):
        shown.append(html.format(**{name: _factor(sizes[name]) for name in names}))
    return shown


def _factor(size: ParameterEstimate) -> Markup:
    """A number as it stands in an equation."""
    text = quantity(size.value, size.unit)
    return Markup("<b>{}</b>").format(f"({text})" if size.value < 0.0 else text)


def size_rows(sizes: Mapping[str, ParameterEstimate]) -> list[tuple[str, ...]]:
    """Rows of the table of sizes: meaning, symbol, value, 95 % interval."""
    return [
        (size.meaning, name, _with_degrees(size.value, size.unit), _interval(size))
        for name, size in sizes.items()
    ]


def _interval(size: ParameterEstimate) -> str:
    return f"{_number(size.low95)} to {_number(size.high95)}"


def _with_degrees(value: float, unit: str) -> str:
    text = quantity(value, unit)
    return f"{text} ({quantity(math.degrees(value), '°')})" if unit == "rad" else text


def detectable_rows(study: GapStudy) -> list[tuple[str, ...]]:
    """What each effect needs to be named on this flight: effect, meaning, size, smallest size."""
    return [
        (
            display_name(d.effect),
            d.parameter.meaning,
            *(
                quantity(size, d.parameter.unit) if math.isfinite(size) else "no size"
                for size in (d.size, d.known_aircraft)
            ),
        )
        for d in study.detectable
    ]


def addition_rows(study: GapStudy) -> list[tuple[str, str, str]]:
    """What the nominal model has beyond the model that was identified: effect, meaning, value."""
    model, had = study.base.result.model, study.base.found.model.values
    return [
        (display_name(effect.name), p.meaning, quantity(model.values[p.name], p.unit))
        for effect in model.effects
        for p in effect.parameters
        if p.name not in had
    ]


# The verdict and the gap


def verdict_sentence(study: GapStudy) -> str:
    """What the prediction errors say, in one sentence."""
    closed, verdict = study.closed, study.naming.verdict
    before, calm = _error(closed.before), _error(closed.calm)
    if closed.after is closed.before:
        only_chance = "; no effect of the catalogue explains more than chance would"
        return (
            f"Two seconds ahead the calm flight's model is off by {before}, on the calm flight "
            f"itself by {calm}{only_chance if verdict == 'none' else ''}."
        )
    share = closed_share(study)
    closes = ""
    if share is not None:
        closes = ", which closes " + (
            "the gap" if share >= 0.995 else f"{100.0 * share:.0f} % of the gap"
        )
    what = "With the term below" if verdict == "outside" else "With what was found"
    if verdict == "ambiguous":
        what = f"With the first of them, {_lower_name(study.naming.chosen[0])},"
    return (
        f"{what} the model is off by {_error(closed.after)} two seconds ahead instead of by "
        f"{before}{closes}; the calm flight leaves {calm}."
    )


def closed_share(study: GapStudy) -> float | None:
    """Share of the gap that is closed; None where there is hardly a gap."""
    closed = study.closed
    over = closed.before.chi2 - closed.calm.chi2
    if not over > SMALLEST_GAP:
        return None
    return 1.0 - (closed.after.chi2 - closed.calm.chi2) / over


def before_after_text(study: GapStudy, floor: NoiseFloor) -> str:
    """The gap in words: where it was, where it is, what the noise alone leaves."""
    closed = study.closed
    noise = (
        f" The pose noise alone leaves chi2 1 ({100.0 * floor.position_m:.1f} cm, "
        f"{floor.attitude_deg:.2f}°)."
    )
    time = (
        "The flight is too short to hold anything back, so this is on the fitted time."
        if closed.seen
        else f"All of this is on {closed.before.windows} windows of two seconds that no fit used."
    )
    if lost := max(closed.before.diverged, closed.after.diverged):
        time += (
            f" In {lost} of them a prediction diverges; an error there counts as "
            f"{DIVERGED_RESIDUAL:,.0f} standard deviations of the noise."
        )
    if closed.after is closed.before:
        return f"Nothing was added to the model, so there is no after.{noise} {time}"
    return (
        f"With the aircraft's own parameters kept as on the calm flight and the effect added, chi2 "
        f"is {closed.after_with_fixed_parameters.chi2:.2f}; with these parameters free within a "
        "day's drift and no effect, "
        f"{closed.before_with_free_parameters.chi2:.2f}.{noise} {time}"
    )


def gap_rows(study: GapStudy, floor: NoiseFloor) -> list[tuple[str, ...]]:
    """Rows of the table of prediction errors: what, chi2, position, attitude."""
    rows = [
        (name, f"{s.chi2:.2f}", f"{100.0 * s.position_m:.1f} cm", f"{s.attitude_deg:.2f}°")
        for name, s in gap_scores(study.closed).items()
    ]
    return [
        *rows,
        ("noise alone", "1", f"{100.0 * floor.position_m:.1f} cm", f"{floor.attitude_deg:.2f}°"),
    ]


def trace_caption(name: str, window: TraceWindow) -> str:
    """The caption of a window's traces."""
    what = {
        "typical": "A typical window (the median)",
        "worst": "The worst window",
    }[name]
    sizes = [f"{value:.2g}" for value in window.chi2]
    errors = f"{sizes[0]} before, {sizes[1]} after" if len(sizes) > 1 else sizes[0]
    return (
        f"{what}: {window.t[0]:.1f} to {window.t[-1]:.1f} s. Mean square error in squared "
        f"sigmas of the noise: {errors}."
    )


# Who came second


def contest_text(study: GapStudy, record: Mapping[str, Any]) -> str:
    """How many were tried, how much is needed, who is first."""
    first = record["ranking"][0]
    return (
        f"{len(record['ranking'])} effects were tried; evidence of {record['threshold']:.0f} is "
        f"needed so that it is not chance. {display_name(first['effect'])} has most: "
        f"{first['gain']:.0f}, probability {_percent(first['probability'])}. Evidence is the chi2 "
        "that an effect explains, divided by how much more it scatters from window to window in "
        "the calm flight than noise does, less k ln n for its k parameters and n measured numbers "
        "(BIC); a "
        f"difference of {VERY_STRONG_EVIDENCE:.0f} is very strong, less leaves both possible."
    )


def second_effect_text(study: GapStudy) -> str:
    """What a second effect that was named explains beyond the first; empty where there is none."""
    chosen = study.naming.chosen
    if study.naming.verdict != "named" or len(chosen) < 2:
        return ""
    first, second = map(_lower_name, chosen[:2])
    return (
        f"Both are there: on top of {first}, {second} explains another "
        f"{chosen[1].delta_chi2:.0f} of chi2."
    )


def runner_up_text(study: GapStudy) -> str:
    """The best effect that is not part of the answer, and why it lost; empty where none was tried.

    Where nothing is named, why the best effect is not an answer.
    """
    naming = study.naming
    answer = {c.effect.name for c in naming.chosen}
    best = next((c for c in naming.ranking if c.effect.name not in answer), None)
    if best is None:
        return ""
    name = display_name(best.effect.name)
    penalty = bic_penalty(best.effect, naming.windows)
    count = len(best.effect.parameters)
    if not naming.chosen:
        return (
            f"{name} comes first and is no answer: it explains {best.delta_chi2:.0f} of chi2, less "
            f"a BIC penalty of {penalty:.0f} for {_parameters(count)}: evidence "
            f"{best.delta_bic:.0f}, {naming.threshold:.0f} needed"
            f"{_full_stop(_bound_text(best))}"
        )
    # Of two named effects the first was ranked by itself, as the runner-up was.
    winner = naming.chosen[0]
    winner_name = _lower_name(winner)
    explained = winner.delta_chi2 - best.delta_chi2
    compared = (
        f"{explained:.0f} less than {winner_name}'s {winner.delta_chi2:.0f}"
        if explained >= 0.5
        else f"as much as {winner_name}"
        if explained > -0.5
        else f"{-explained:.0f} more than {winner_name}'s {winner.delta_chi2:.0f}"
    )
    winner_penalty = bic_penalty(winner.effect, naming.windows)
    behind = winner.delta_bic - best.delta_bic
    is_weakened = abs(behind - (explained - winner_penalty + penalty)) > 1.0
    weakened = " (residuals that err alike through a window count for less)" if is_weakened else ""
    text = [
        f"{name} came second: it explains {best.delta_chi2:.0f} of chi2, {compared}.",
        f"For {_parameters(count)} its BIC penalty is {penalty:.0f}, that of {winner_name} "
        f"{winner_penalty:.0f}; so it ends {behind:.0f} of evidence behind{weakened}"
        f"{_full_stop(_bound_text(best))}",
    ]
    if winner.effect.name in best.effect.contains:
        text.append(
            f"It contains {winner_name} as a special case, so it always explains as much, and "
            "loses by its further parameters."
        )
    where = _where_worse(winner, best, naming.windows)
    if where:
        text.append(where)
    if best.result is None:
        text.append("It was too far behind in the linear scan for a full fit.")
    text += [
        f"{display_name(c.effect.name)} explains {c.delta_chi2:.0f} as well, but {reason}."
        for c, reason in _excluded(study)
        if c.effect.name != best.effect.name and c.delta_chi2 > best.delta_chi2
    ]
    return " ".join(text)


def _excluded(study: GapStudy) -> list[tuple[EffectCandidate, str]]:
    """Effects whose fit does not count whatever it explains, each with the reason."""
    answer = {c.effect.name for c in study.naming.chosen}
    reasons = [(c, _bound_text(c)) for c in study.naming.ranking if c.effect.name not in answer]
    return [(c, reason) for c, reason in reasons if "does not count" in reason]


def _bound_text(candidate: EffectCandidate) -> str:
    """Why its fit does not count, or that a parameter ended on its bound; empty for neither."""
    held = [p.name for p in candidate.effect.parameters if _on_bound(p, candidate.values[p.name])]
    bounds = "its bound" if len(held) == 1 else "their bounds"
    ended = f"its fit ended with {', '.join(held)} on {bounds}" if held else ""
    if not candidate.is_identifiable:
        essential = ", ".join(candidate.effect.essential)
        return (
            f"{ended or f'{essential} may be zero within its 95 % interval'}, so what it explains "
            "does not count"
        )
    return ended


def _on_bound(p: Parameter, value: float) -> bool:
    return not p.low + 1e-6 < value < p.high - 1e-6


def _where_worse(winner: EffectCandidate, other: EffectCandidate, windows: Windows) -> str:
    """The channel in which the other leaves most of what the winner explains; empty if unknown."""
    if winner.result is None or other.result is None:
        return ""
    left = [
        np.sum(pose_residuals(c.result.residual, windows) ** 2, axis=(0, 1))
        for c in (winner, other)
        if c.result is not None
    ]
    more = np.maximum(left[1] - left[0], 0.0)
    if not np.isfinite(more).all() or more.sum() < VERY_STRONG_EVIDENCE:
        return ""
    k = int(np.argmax(more))
    channel = list(CHANNEL_WORDS.values())[k].lower()
    return (
        f"What it fails to explain is mostly in {channel} ({100.0 * more[k] / more.sum():.0f} %)."
    )


def _parameters(count: int) -> str:
    return f"{count} parameter" + ("" if count == 1 else "s")


def _full_stop(text: str) -> str:
    return f"; {text}." if text else "."


# Where the residuals stand out


def where_text(study: GapStudy) -> str:
    """The three largest excesses in words."""
    if not study.residual_bins:
        return "Nowhere: no channel stands out over any variable by more than chance."
    level, calm_level = (
        float(np.nanmean(r.residual**2)) for r in (study.flight_replay, study.baseline_replay)
    )
    places = "; ".join(_place(residual_bin) for residual_bin in study.residual_bins[:3])
    return (
        f"Over the whole flight the mean square residual is {level:.2g} squared sigmas of the pose "
        f"noise, on the calm flight {calm_level:.2g}. Most of it is in {places}; excess is what is "
        "over the calm flight's."
    )


def _place(residual_bin: ResidualBin) -> str:
    at = "all the time alike"
    if residual_bin.contrast > 0.0:
        scale, unit = IN_PLOTS.get(residual_bin.variable, (1.0, VARIABLES[residual_bin.variable]))
        low, high = (quantity(scale * v, "") for v in (residual_bin.low, residual_bin.high))
        unit = "" if unit == "-" else f" {unit}"
        at = f"with {residual_bin.variable} from {low} to {high}{unit}"
    channel = CHANNEL_WORDS[residual_bin.channel].lower()
    return f"{channel} {at} (excess {residual_bin.excess_chi2:.2g})"


# Small things


def noise_text(noise: Mapping[str, Any]) -> str:
    """The pose noise and the share of it that changes slowly."""
    halves = zip(noise["slow_share"], noise["slow_time_s"], ("position", "attitude"), strict=True)
    slow = "; ".join(
        f"{100 * share:.0f} % of it slow over {seconds:.1f} s in {half}"
        if share
        else f"none of it slow in {half}"
        for share, seconds, half in halves
    )
    return (
        f"Pose noise {100 * noise['position_m']:.1f} cm and {noise['attitude_deg']:.2f}° per axis "
        f"(standard deviation); {slow}."
    )


def _error(score: PredictionScore) -> str:
    return f"{100 * score.position_m:.1f} cm and {score.attitude_deg:.2f}° (chi2 {score.chi2:.2f})"


def display_name(name: str) -> str:
    """An effect's name as it begins a sentence."""
    return (name[:1].upper() + name[1:]).replace("_", " ")


def _lower_name(candidate: EffectCandidate) -> str:
    return candidate.effect.name.replace("_", " ")


def _percent(probability: float) -> str:
    return "over 99 %" if probability > 0.99 else f"{100 * probability:.0f} %"


def sentence(text: str) -> str:
    """A text that begins with a capital and ends with a full stop."""
    return text[:1].upper() + text[1:] + ("" if text.endswith((".", "?")) else ".")
