"""The report: fixed keys, honest words, and every labelled case named right."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from falconwing_kit.aircraft.effects import EFFECT_NAMES
from falconwing_kit.core.checks import InputError
from falconwing_kit.core.flight_table import read_flight_table, slice_time
from falconwing_kit.gap.close import Onset
from falconwing_kit.gap.name import MAX_MAHALANOBIS
from falconwing_kit.gap.study import gap_record, require_pair
from falconwing_kit.sysid.model_file import read_model
from falconwing_kit.tools.reports.gap_report import gap_report, write_gap
from tests.gap.studies import shipped, wind_study
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
    record = gap_record(wind_study())
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
    ranking = gap_record(wind_study())["ranking"]
    gains = [r["gain"] for r in ranking]
    assert gains == sorted(gains, reverse=True)
    assert all(0.001 <= r["probability"] <= 0.999 for r in ranking)
    assert ranking[0]["probability"] > 0.99
    by_name = {r["effect"]: r for r in ranking}
    assert by_name["time_offset"]["same_as"] == "control_delay"
    assert by_name["time_offset"]["gain"] == by_name["control_delay"]["gain"]


def test_report_is_written_whole_and_the_model_reads_back(tmp_path):
    """Page, record, four figures and two models; the model with the effect has the wind that was
    found.
    """
    record = write_gap(wind_study(), tmp_path)
    written = {path.name for path in tmp_path.iterdir()}
    assert written == {
        "report.json",
        "report.html",
        "gap_map.png",
        "gap_where.png",
        "gap_ranking.png",
        "gap_closed.png",
        "model.toml",
        "model_with_effect.toml",
    }
    assert json.loads((tmp_path / "report.json").read_text())["parameters"] == record["parameters"]
    page = (tmp_path / "report.html").read_text()
    assert page.count("data:image/png;base64,") == 4
    assert "http" not in page
    model = read_model(tmp_path / "model_with_effect.toml").model
    assert model.values["wind_y"] == pytest.approx(
        record["parameters"]["wind_y"]["value"], rel=1e-6
    )
    assert [e.name for e in model.effects] == ["wind"]
    assert read_model(tmp_path / "model.toml").model.effects == ()


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
