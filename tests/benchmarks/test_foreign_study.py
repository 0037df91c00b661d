"""The foreign study's judgement and figures, by hand."""

import pytest

from tests.benchmarks.foreign_flights import AIRCRAFT, effects_of
from tests.benchmarks.foreign_study import cases, coverage, gap_closed, judge, summary


def row(effect, answer, found=(), **more):
    """A finished row."""
    return {
        "key": f"cub {effect} 1 bare", "aircraft": "cub", "effect": effect, "seed": 1,
        "airframe": False, "answer": answer, "effects": list(found), "ranking": [],
        "parameters": {}, "truth": {"kit": {}}, "cpu_s": 1.0, **more,
    }  # fmt: skip


@pytest.mark.parametrize(
    ("effect", "answer", "found", "word"),
    [
        ("wind", "named", ["wind"], "right"),
        ("time_offset", "named", ["control_delay"], "right"),  # one class
        ("wind", "named", ["flap"], "wrong name"),
        ("wind", "named", ["wind", "flap"], "wrong name"),
        ("wind+flap", "named", ["flap", "wind"], "right"),
        ("wind+flap", "named", ["flap"], "part"),
        ("wind", "ambiguous", ["flap", "wind", "stall"], "ambiguous with it"),
        ("wind", "ambiguous", ["flap", "wind", "stall", "deadband"], "wrong name"),
        ("wind", "none", [], "quiet"),
        ("wind", "outside", [], "outside"),
        ("none", "none", [], "right"),
        ("none", "outside", [], "outside"),
        ("none", "named", ["wind"], "wrong name"),
        ("prop_wash", "outside", [], "right"),
        ("prop_wash", "named", ["wind"], "wrong name"),
        ("prop_wash", "none", [], "quiet"),
        ("wind", "refused", [], "refused"),
        ("none", "traceback", [], "traceback"),
    ],
)
def test_an_answer_gets_one_word(effect, answer, found, word):
    """The rules in `judge`, case by case."""
    assert judge(row(effect, answer, found)) == word


def test_figures_count_what_they_say():
    """By hand: (3 - 1.5) / (3 - 1) = 0.75; one interval of two holds its truth; one false alarm."""
    good = row(
        "wind", "named", ["wind"], gap=[3.0, 1.5, 1.0],
        truth={"kit": {"wind_x": 1.0, "wind_y": 2.0}},
        parameters={"wind_x": [1.1, 0.9, 1.3], "wind_y": [2.5, 2.2, 2.8], "other": [1, 0, 2]},
    )  # fmt: skip
    small = row("wind", "none", gap=[1.1, 1.1, 1.0])
    rows = [good, small, row("none", "none"), row("none", "named", ["flap"]),
            row("flap", "traceback", message="boom", where="x.py:1")]  # fmt: skip
    assert gap_closed(rows) == [0.75]
    assert coverage(rows) == [True, False]
    text = "\n".join(summary(rows))
    assert "1 of 2" in text
    assert "traceback: cub flap 1 bare: boom at x.py:1" in text
    assert "median 75 %" in text


def test_a_study_meets_every_aircraft_and_every_kind_once_each():
    """Keys never repeat, effects are ones that the aircraft can have, a fifth or more is quiet."""
    some = list(cases(100, 160))
    assert len({case.key for case in some}) == 160
    assert {case.aircraft for case in some} == set(AIRCRAFT)
    for case in some:
        assert set(case.effect.split("+")) <= set(effects_of(case.aircraft))
    share = sum(case.effect == "none" for case in some) / len(some)
    assert 0.2 < share < 0.4
    assert any("+" in case.effect for case in some)
    assert {case.with_airframe for case in some} == {True, False}
    stressed = list(cases(100, 28, stress=True))
    assert any(case.options.get("missing") == 0.3 for case in stressed)
    assert any(case.options.get("gust") for case in stressed)
