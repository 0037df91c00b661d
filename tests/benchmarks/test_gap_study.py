"""The study's own judgement: what counts as right, as half and as wrong, by the rules written in
README.
"""

import json

import pytest

from tests.benchmarks.gap_study import answer, cases, is_wrong, points, summary
from tests.gap.studies import wind_study
from tests.hidden_effects import IN_CATALOGUE


@pytest.mark.parametrize(
    ("effect", "verdict", "found", "worth", "wrong"),
    [
        ("wind", "named", ["wind"], 1.0, False),
        ("time_offset", "named", ["control_delay"], 1.0, False),  # one class
        ("wind", "named", ["flap"], 0.0, True),
        ("wind", "named", ["wind", "flap"], 0.0, True),  # says a thing that is not so
        ("wind+flap", "named", ["flap", "wind"], 1.0, False),
        ("wind+flap", "named", ["flap"], 0.0, False),  # says too little, and nothing wrong
        ("wind", "ambiguous", ["flap", "wind", "stall"], 0.5, False),
        (
            "wind",
            "ambiguous",
            ["flap", "wind", "stall", "deadband"],
            0.0,
            False,
        ),  # more than three say nothing
        ("wind", "ambiguous", ["flap", "stall"], 0.0, True),
        ("wind", "none", [], 0.0, False),
        ("wind", "outside", [], 0.0, False),
        ("none", "none", [], 1.0, False),
        ("none", "outside", [], 0.0, False),
        ("none", "named", ["wind"], 0.0, True),
    ],
)
def test_an_answer_is_judged_by_what_it_says(effect, verdict, found, worth, wrong):
    """The rules by hand: right 1, a set of at most three that holds the truth one half, else 0."""
    row = {"verdict": verdict, "effects": found}
    assert points(row, effect) == worth
    assert is_wrong(row, effect) == wrong


def test_cases_meet_every_effect_and_every_noise_with_seeds_of_their_own():
    """Counted: 95 flights of the other simulator, all 19 effects, three noises, a third with slow
    noise, no seed twice; calm flights half with slow noise; the kit's own aircraft fly all effects
    of a round on one seed.
    """
    independent = list(cases("independent", 100, None, 38))
    assert len({c.seed for c in independent}) == 95
    assert {c.effect for c in independent} == set(IN_CATALOGUE)
    assert {c.noise for c in independent} == {"marker", "hybrid", "net"}
    assert sum(c.correlated for c in independent) == pytest.approx(95 / 3, abs=2)
    assert sum(c.withhold for c in independent) == 38
    calm = list(cases("calm", 100, None, 0))
    assert (len(calm), sum(c.correlated for c in calm)) == (60, 30)
    own = list(cases("own", 100, None, 0))
    assert {c.seed for c in own} == {100, 101, 102, 103, 104}


def test_summary_counts_rows():
    """Two calm flights, one named wrongly: a half is right, one name is wrong."""
    row = {
        "kind": "calm",
        "seed": 1,
        "effect": "none",
        "noise": "marker",
        "correlated": False,
        "verdict": "none",
        "effects": [],
        "ranking": [["wind", -3.0]],
        "place": None,
        "unnamed": ["force with airspeed", -9.0],
        "left": 0.0,
        "excess": 0.0,
        "seconds": {"calm": 5.0},
    }
    rows = [row, {**row, "seed": 2, "verdict": "named", "effects": ["wind"]}]
    assert json.loads(json.dumps(rows)) == rows
    text = "\n".join(summary(rows))
    assert "2 flights, right 1 (0.500), wrong name 1" in text
    assert "not right: 2 none marker -> named wind" in text


def test_an_answer_is_a_line_of_json_with_the_verdict():
    """Of the shipped flight in wind (its truth.json): named, in the first place, little left."""
    line = json.loads(json.dumps(answer(wind_study().naming, "wind")))
    assert (line["verdict"], line["effects"], line["place"]) == ("named", ["wind"], 1)
    assert abs(line["left"]) < 0.1 * line["excess"]
