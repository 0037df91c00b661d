"""The report: fixed keys, honest words, and every labelled case named right."""

import html
import json
import math
import re
import shutil
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest

from falconwing_kit.aircraft.effects import EFFECT_NAMES
from falconwing_kit.aircraft.generic import GENERIC_EFFECTS
from falconwing_kit.core.checks import InputError
from falconwing_kit.core.flight_table import read_flight_table, slice_time
from falconwing_kit.data import data_path
from falconwing_kit.gap import study as study_module
from falconwing_kit.gap.close import Onset, ParameterEstimate
from falconwing_kit.gap.name import MAX_MAHALANOBIS
from falconwing_kit.gap.study import gap_record, require_pair
from falconwing_kit.sysid.model_file import read_model
from falconwing_kit.sysid.shooting import fly_windows, select_windows
from falconwing_kit.tools.reports import gap_report as gap_report_module
from falconwing_kit.tools.reports.gap_plots import noise_floor
from falconwing_kit.tools.reports.gap_report import gap_report, write_gap
from falconwing_kit.tools.reports.gap_text import (
    addition_rows,
    effect_equations,
    equation,
    quantity,
    runner_up_text,
)
from falconwing_kit.tools.reports.gap_traces import example_windows
from tests.gap.studies import EFFECTS, shipped, wind_study
from tests.manual.book import elements
from tests.tools.reports.test_page import page_problems

CASES = Path(__file__).resolve().parents[4] / "shared" / "data" / "flights"
ALWAYS = ("case03", "case04", "case05", "case09")  # the other six run with `-m benchmark`
SIZES = {  # truth.json's sizes in the kit's parameters, and how near the goal asks for
    "case01": {"ground_lift": (0.5197, 0.104)},  # 20 %
    "case00": {"sag": (0.2281, 0.0456)},  # 20 %
    "case08": {"wind_x": (0.0924, 0.05), "wind_y": (0.4370, 0.05)},  # 0.05 m/s
    "case09": {"control_delay": (0.0507, 0.010)},  # 10 ms
}
KEYS = ("verdict", "effects", "ranking", "parameters", "where", "gap", "gap_rmse", "next_flight")


def test_record_has_the_fixed_keys():
    """DESIGN.md, section 6: these keys first and in this order, each with these fields."""
    record = wind_record()
    assert tuple(record)[:8] == KEYS
    assert record["verdict"] == "named"
    assert record["effects"] == ["wind"]
    assert sorted(r["effect"] for r in record["ranking"]) == sorted(EFFECT_NAMES)
    assert all({"effect", "gain", "probability"} <= set(r) for r in record["ranking"])
    assert all(
        set(p) == {"value", "low95", "high95", "unit"} for p in record["parameters"].values()
    )
    assert record["where"]
    assert all(set(w) == {"channel", "variable", "from", "to", "excess"} for w in record["where"])
    assert set(record["gap"]) == {"before", "after", "calm"}
    assert {k: set(v) for k, v in record["gap_rmse"].items()} == {
        "position_m": {"before", "after", "calm"}, "attitude_deg": {"before", "after", "calm"},
    }  # fmt: skip
    assert record["next_flight"]
    json.dumps(record, allow_nan=False)


def test_ranking_is_in_order_and_probabilities_are_no_certainties():
    """Best first; a probability is within 0.001 and 0.999, and twins share theirs, as they share
    their dynamics.
    """
    ranking = wind_record()["ranking"]
    gains = [r["gain"] for r in ranking]
    assert gains == sorted(gains, reverse=True)
    assert all(0.001 <= r["probability"] <= 0.999 for r in ranking)
    assert ranking[0]["probability"] > 0.99
    by_name = {r["effect"]: r for r in ranking}
    assert by_name["time_offset"]["same_as"] == "control_delay"
    assert by_name["time_offset"]["gain"] == by_name["control_delay"]["gain"]


@cache
def wind_record():
    """What report.json holds for it; the advice in it takes a second."""
    return gap_record(wind_study())


@pytest.fixture(scope="module")
def written(tmp_path_factory):
    """The folder of the wind study's report."""
    folder = tmp_path_factory.mktemp("report")
    write_gap(wind_study(), folder)
    return folder


def test_report_is_written_whole_and_the_model_reads_back(written):
    """Page, record, six figures and two models; the model with the effect has the wind that was
    found; the page with its figures is below 1.5 MB.
    """
    record = wind_record()
    assert {path.name for path in written.iterdir()} == {
        "report.json",
        "report.html",
        "gap_map.png",
        "gap_where.png",
        "gap_ranking.png",
        "gap_closed.png",
        "gap_typical.png",
        "gap_worst.png",
        "model.toml",
        "model_with_effect.toml",
    }
    assert json.loads((written / "report.json").read_text())["parameters"] == record["parameters"]
    page = (written / "report.html").read_text()
    assert page.count("data:image/png;base64,") == 6
    assert len(page) < 1.5e6
    assert "http" not in page
    model = read_model(written / "model_with_effect.toml").model
    assert model.values["wind_y"] == pytest.approx(
        record["parameters"]["wind_y"]["value"], rel=1e-6
    )
    assert [e.name for e in model.effects] == ["wind"]
    assert read_model(written / "model.toml").model.effects == ()


def test_page_says_since_when_and_why_nothing_is_named(tmp_path):
    """Outside, on an aircraft that does not fit, with a load that explains more and from a time on:
    each is said.
    """
    study = wind_study()
    effect = study.naming.ranking[0].effect
    load = replace(study.naming.generic, delta_bic=study.naming.ranking[0].delta_bic + 50.0)
    naming = replace(
        study.naming, verdict="outside", chosen=(), mahalanobis=10.0 * MAX_MAHALANOBIS, generic=load
    )
    closed = replace(study.closed, after=study.closed.before, parameters={})
    onset = Onset(effect, 12.34, 11.0, 13.0, 40.0, None)
    names = ("<i>calm</i>.csv", "<i>flight</i>.csv")
    write_gap(replace(study, naming=naming, closed=closed, since=onset, names=names), tmp_path)
    page = (tmp_path / "report.html").read_text(encoding="utf-8")
    assert "set in at <strong>12.3 s</strong>" in page
    assert f"<strong>{load.effect.name}</strong> (evidence {load.delta_bic:.0f})" in page
    assert (
        page.count("are both flights of the same aircraft?") == 2
    )  # in the text and among the warnings
    assert "<i>" not in page and "&lt;i&gt;flight&lt;/i&gt;.csv, judged by" in page
    assert page_problems(page) == []


@pytest.mark.parametrize(
    ("verdict", "kept", "words"),
    [
        ("ambiguous", 2, "cannot separate them"),
        ("none", 0, "agrees with the calm one"),
        ("outside", 0, "no effect of the catalogue explains enough"),
    ],
)
def test_page_says_what_the_verdict_is(tmp_path, verdict, kept, words):
    """The same findings under each other verdict: no model with an effect, no confident headline, a
    next flight.
    """
    study = wind_study()
    ranking = {c.effect.name: c for c in study.naming.ranking}
    chosen = (ranking["wind"], ranking["fan_jet"])[:kept]
    naming = replace(study.naming, verdict=verdict, chosen=chosen)
    closed = (
        study.closed if kept else replace(study.closed, after=study.closed.before, parameters={})
    )
    record = write_gap(replace(study, naming=naming, closed=closed), tmp_path)
    page = (tmp_path / "report.html").read_text()
    assert words in page
    assert "Missing: wind<" not in page
    assert not (tmp_path / "model_with_effect.toml").exists()
    assert record["effects"] == (["wind", "fan_jet"] if kept else [])
    if verdict == "ambiguous":
        assert "both directions" in record["next_flight"]  # what parts a wind from a fan's stream


def words_of(folder) -> str:
    """The page's text as a reader sees it: no tags, one space between words."""
    page = (folder / "report.html").read_text(encoding="utf-8")
    assert page_problems(page) == []
    page = re.sub(r"<style.*?</style>|<[^>]+>", "", page, flags=re.DOTALL)
    return re.sub(r"\s+", " ", html.unescape(page))


def test_page_shows_the_equation_with_the_fitted_numbers(written):
    """Symbols first, then the record's own values with their unit and intervals."""
    page, sizes = words_of(written), wind_record()["parameters"]
    numbers = ", ".join(f"{sizes[n]['value']:.3g} m/s" for n in ("wind_x", "wind_y"))
    assert "(wind_x, wind_y, 0)" in page and f"({numbers}, 0)" in page
    for size in sizes.values():
        assert f"{size['low95']:.3g} to {size['high95']:.3g}" in page


def test_equation_is_marked_up_and_may_be_missing():
    """By hand: powers, arrow, minus signs and a negative number in parentheses; a user's effect
    need not have an equation.
    """
    size = ParameterEstimate(-0.2, -0.3, -0.1, "1/m^2", "yawing moment")
    yaw = EFFECTS["adverse_yaw"]
    symbols, numbers = effect_equations(yaw, {"adverse_yaw": size})
    assert symbols == "dr/dt → dr/dt − adverse_yaw V<sup>2</sup> aileron"
    assert numbers == "dr/dt → dr/dt − <b>(−0.2/m^2)</b> V<sup>2</sup> aileron"
    assert effect_equations(replace(yaw, equation=""), {"adverse_yaw": size}) == []
    assert equation("a < b, V_a, alpha") == "a &lt; b, V<sub>a</sub>, α"


def test_runner_up_is_judged_in_words():
    """By hand: 852 against 812 is 40 less; of one parameter less, whose price ln n is saved, the
    evidence is 40 less that price behind; one that ended on its bound, or whose explanation does
    not count, is said.
    """
    study = wind_study()
    first, effects = study.naming.chosen[0], {c.effect.name: c for c in study.naming.ranking}
    price = math.log(study.naming.windows.count)

    def behind(name, chi2, *others, **how):
        other = replace(
            effects[name], delta_chi2=chi2, delta_bic=how.pop("delta_bic", chi2 - price), **how
        )
        best = replace(first, delta_chi2=852.0, delta_bic=852.0 - 2.0 * price)
        naming = replace(study.naming, chosen=(best,), ranking=(best, other, *others))
        return runner_up_text(replace(study, naming=naming))

    drag = effects["extra_drag"]
    text = behind("extra_drag", 812.0, values={"drag_added": 0.01}, result=None)
    assert "Extra drag came second: it explains 812 of chi2, 40 less than wind's 852." in text
    assert f"For 1 parameter its BIC penalty is {price:.0f}, that of wind {2.0 * price:.0f}" in text
    assert f"ends {40.0 - price:.0f} of evidence behind." in text
    assert "too far behind in the linear scan" in text
    held = behind("extra_drag", 812.0, values={"drag_added": drag.effect.parameters[0].high})
    assert "its fit ended with drag_added on its bound." in held
    assert "count for less" not in text
    weak = behind("extra_drag", 854.0, delta_bic=700.0)  # as by a variance factor of 1.2
    assert "2 more than wind's 852" in weak and "through a window count for less)" in weak
    jet = replace(
        effects["fan_jet"], delta_chi2=860.0, delta_bic=0.0, result=first.result,
        values={**effects["fan_jet"].values, "jet_radius": 8.0},
    )  # fmt: skip
    assert (
        "Fan jet explains 860 as well, but its fit ended with jet_radius on its bound, so what it "
        "explains does not count."
    ) in behind("extra_drag", 812.0, jet)


def test_traces_are_the_models_flown_over_held_out_time():
    """The error plus the measurement is the nominal model's own flight from the fitted states; the
    worst window has the largest error, and half of the others are below the typical one.
    """
    study = wind_study()
    closed, windows = study.closed, study.base.with_measurement_weights(study.naming.windows)
    held_out = select_windows(windows, closed.held_out)
    flown = fly_windows(study.base.result.model, held_out, closed.before.initial_states)
    chi2 = np.sort(np.mean(closed.before.residual**2, axis=(1, 2)))
    examples = example_windows(study)
    for name, rank in (("typical", (len(chi2) - 1) // 2), ("worst", -1)):
        window = examples[name]
        w = int(np.argmin(abs(held_out.nodes[:, 0] + held_out.flights[0].t[0] - window.t[0])))
        known = np.isfinite(window.before)
        predicted = window.measured + window.before
        turns = np.round((predicted - flown[w])[known] / (2.0 * np.pi))
        np.testing.assert_allclose(
            predicted[known] - 2.0 * np.pi * turns, flown[w][known], atol=1e-9
        )
        assert set(turns[np.nonzero(known)[1] < 5]) == {0.0}  # only yaw is shown modulo a turn
        assert window.chi2[0] == pytest.approx(chi2[rank], rel=0.02)  # rows without a pose: 1 %
        assert window.chi2[1] < 0.5 * window.chi2[0]
    same = replace(study, closed=replace(closed, after=closed.before))
    assert all(window.after is None for window in example_windows(same).values())


def test_noise_floor_by_hand():
    """Three axes of the same noise: sqrt(3) of it in position, the noise itself in attitude, each
    less what 12 initial states of a window absorb.
    """
    study = wind_study()
    windows = study.naming.windows
    share = math.sqrt(1.0 - 12.0 * len(windows) / windows.count)
    sigma = np.array([0.03, 0.03, 0.03, 0.01, 0.01, 0.01])
    found = replace(study.base.found, sigma=sigma)
    floor = noise_floor(replace(study, base=replace(study.base, found=found)))
    assert floor.position_m == pytest.approx(share * 0.03 * math.sqrt(3.0), rel=1e-9)
    assert floor.attitude_deg == pytest.approx(share * math.degrees(0.01), rel=1e-9)
    assert 0.9 < share < 1.0


def test_page_says_what_the_nominal_model_was_given():
    """A load added on the calm flight stands with its value, and nothing else does."""
    study = wind_study()
    load = next(e for e in GENERIC_EFFECTS if e.name == "moment with throttle")
    model = study.base.result.model.with_effect(load).with_values({load.parameters[0].name: -0.125})
    base = replace(study.base, result=replace(study.base.result, model=model))
    assert addition_rows(study) == []
    rows = addition_rows(replace(study, base=base))
    assert [row[0] for row in rows] == ["Moment with throttle"] * 3
    assert rows[0][2] == "−0.125 rad/s^2"


def test_term_outside_the_catalogue_is_shown(tmp_path, monkeypatch):
    """The record's optional key `discrepancy`: equation, numbers, where and what it resembles."""
    term = {"name": "k", "value": -0.0123, "low95": -0.02, "high95": -0.01, "unit": "1/m^2"}
    discrepancy = {
        "equation": "dp/dt -> dp/dt + k V^2 rudder",
        "where": "with rudder beyond 0.3",
        "terms": [term],
        "resembles": "rolling moment of rudder, L_dr",
        "gap_closed": 0.73,
    }
    study = wind_study()
    record = {**wind_record(), "discrepancy": discrepancy}
    monkeypatch.setattr(gap_report_module, "gap_record", lambda study: record)
    naming = replace(study.naming, verdict="outside", chosen=())
    write_gap(replace(study, naming=naming), tmp_path)
    page = words_of(tmp_path)
    assert "closes 73 % of the gap" in page and "dp/dt → dp/dt + k V2 rudder" in page
    assert "−0.0123/m^2" in page and "−0.02 to −0.01" in page
    assert "It acts with rudder beyond 0.3. It resembles rolling moment of rudder, L_dr." in page


def test_the_manuals_program_writes_the_report(tmp_path, monkeypatch, capsys):
    """The block as printed, in a folder with the kit's data; the study itself is the cached one."""
    (program,) = [found["value"] for found in elements("<program>")]
    data = tmp_path / "falconwing_kit" / "data"
    data.mkdir(parents=True)
    for name in ("case08_calm.csv", "case08_flight.csv"):
        shutil.copy(data_path(name), data)
    studied = []
    monkeypatch.setattr(
        study_module, "study_gap", lambda *pair, **how: studied.append(pair) or wind_study()
    )
    monkeypatch.chdir(tmp_path)
    exec(program, {})
    assert [Path(table.name).stem for table in studied[0]] == ["case08_calm", "case08_flight"]
    assert capsys.readouterr().out.startswith("['wind'] {'wind_x': {'value': 0.09")
    assert (tmp_path / "gap" / "report.html").is_file() and len(program.splitlines()) <= 8


@pytest.mark.parametrize(
    ("value", "unit", "text"),
    [
        (0.43751, "m/s", "0.438 m/s"),
        (-0.2, "1/m", "−0.2/m"),
        (0.0123, "1/(m rad)", "0.0123/(m rad)"),
        (0.05, "-", "0.05"),
    ],
)
def test_a_quantity_has_three_digits_and_its_unit(value, unit, text):
    """By hand."""
    assert quantity(value, unit) == text


def test_calm_flight_of_another_aircraft_gives_no_name():
    """Two calm flights of two aircraft whose coefficients differ by 15 %: what parts them is no
    effect.
    """
    record = gap_report(shipped("case02_calm"), slice_time(shipped("case08_calm"), 0.0, 60.0))
    assert record["verdict"] == "outside"
    assert record["effects"] == []
    assert any("same aircraft" in w for w in record["warnings"])


def test_flights_that_cannot_answer_are_refused():
    """Each in one sentence that names the flight: too short, no poses, still sticks, two rates."""
    good = shipped("case08_flight")
    blind = replace(good, p_world=np.full_like(good.p_world, np.nan))
    still = replace(good, commands=np.full_like(good.commands, 0.3))
    slow = replace(good, t=2.0 * good.t)
    for bad, words in (
        (slice_time(good, 0.0, 12.0), "at least 20 s"),
        (blind, "poses"),
        (still, "sticks that move"),
        (slow, "one rate"),
    ):
        for pair in ((good, bad), (bad, good)):
            with pytest.raises(InputError, match=words):
                require_pair(*pair)


@pytest.mark.parametrize(
    "case",
    [
        name if name in ALWAYS else pytest.param(name, marks=pytest.mark.benchmark)
        for name in (f"case{n:02d}" for n in range(10))
    ],
)
def test_labelled_case_is_named_right(case):
    """Ten cases of independent JSBSim aircraft with their answers in truth.json; sizes as near as
    the goals ask.
    """
    if not (CASES / case).is_dir():
        pytest.skip("the labelled cases are not on this machine")
    truth = json.loads((CASES / "truth.json").read_text())[case]["effect"]
    record = gap_report(
        *(read_flight_table(CASES / case / f"{name}.csv") for name in ("calm", "flight"))
    )
    if truth == "none":
        assert record["verdict"] == "none"
        assert record["where"] == []
        assert record["gap"]["after"] == record["gap"]["before"]
        return
    assert (record["verdict"], record["effects"]) == ("named", [truth])
    for name, (value, within) in SIZES.get(case, {}).items():
        assert record["parameters"][name]["value"] == pytest.approx(value, abs=within)
    gap = record["gap"]
    assert (
        gap["after"] - gap["calm"] < 0.15 * (gap["before"] - gap["calm"]) + 0.05
    )  # 0.05: scatter of ten windows
