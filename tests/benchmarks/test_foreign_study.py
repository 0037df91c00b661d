"""The foreign study's judgement and figures, by hand."""

import pytest

from tests.benchmarks.foreign_flights import AIRCRAFT, effects_of
from tests.benchmarks.foreign_study import (
    cases,
    coverage,
    gap_closed,
    judge,
    median,
    read_rows,
    reliability,
    share,
    study_before,
    summary,
)


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
    inf = float("inf")  # a prediction that diverges: all of it closed where the answer's does not
    lost = [row("wind", "named", ["wind"], gap=[inf, after, 1.0]) for after in (1.0, inf)]
    assert gap_closed(lost) == [1.0, 0.0]
    assert coverage(rows) == [True, False]
    text = "\n".join(summary(rows))
    assert "nothing hidden, quiet: 1 of 2 = 0.500" in text
    assert "traceback: cub flap 1 bare: boom at x.py:1" in text
    assert "median 75.0 %" in text


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


def test_intervals_are_those_of_the_books():
    """Wilson's for 8 of 10 by hand: (0.8 + 0.192) / 1.384 -+ 0.227; of nine values the second and
    eighth hold the median with 1 - 2 (1 + 9) / 512 = 96 %, the third and seventh with 82 % only.
    """
    assert share(8, [None] * 10) == "8 of 10 = 0.800 [0.490, 0.943]"
    assert share(0, []) == "0 of 0"
    assert median([9.0, 1.0, 2.0, 3.0, 4.0, 5.0, 6.0, 7.0, 8.0]) == "median 5.0 [2.0, 8.0]"


def test_reliability_is_the_distance_of_said_from_seen():
    """By hand: two flights said 0.8, one right: 0.3 off; two said 0.2 and both wrong: 0.2 off."""
    rows = [
        row("wind", "named", ranking=[["wind", 30.0, 0.8], ["flap", 1.0, 0.1]]),
        row("none", "none", ranking=[["wind", 30.0, 0.8]]),
        row("prop_wash", "outside", ranking=[["wind", 2.0, 0.2]]),
        row("time_offset+flap", "none", ranking=[["stall", 2.0, 0.2]]),
        row("wind", "refused"),
    ]
    error, lines = reliability(rows)
    assert error == pytest.approx((2 * 0.3 + 2 * 0.2) / 4)
    assert len(lines) == 2
    assert reliability([row("time_offset", "named", ranking=[["control_delay", 9.0, 1.0]])])[0] == 0


def test_a_study_can_be_cut_short_and_gone_on_with(tmp_path):
    """No flight begins after the deadline; a line that was cut short is as if not there."""
    assert study_before(0.0, next(cases(100, 1))) is None
    file = tmp_path / "rows.jsonl"
    assert read_rows(file) == []
    file.write_text('{"key": "a"}\n{"key": "b"}\n{"ke')
    assert [r["key"] for r in read_rows(file)] == ["a", "b"]
