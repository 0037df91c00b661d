"""The list of parts: mass, balance and cost by hand, the paper's numbers kept, and wrong lists
refused.
"""

from dataclasses import replace

import pytest

from falconwing_kit.aircraft.airframe import load_airframe
from falconwing_kit.core.checks import InputError
from falconwing_kit.core.files import shipped_path
from falconwing_kit.tools.hardware.cameras import load_camera
from falconwing_kit.tools.hardware.parts import (
    COLUMNS,
    balance_move,
    load_parts,
    paper_sums,
    roll_up,
    with_option,
)

HEAD = ",".join(COLUMNS)
SMALL = """\
body,body,1,100,measured,40,50,measured,aircraft,,,,
cell,cell,1,20,measured,-10,5,measured,aircraft,body,,,
eye,eye,2,5,paper,-160,7,estimate,aircraft,,,5 g,
lens,lens,1,30,measured,-160,9,estimate,option,,eye,,
desk,desk,1,,,,,not counted,ground,,,,
"""


def read(folder, rows=SMALL):
    path = folder / "parts.csv"
    path.write_text(f"{HEAD}\n{rows}", encoding="utf-8")
    return load_parts(path)


def shipped_with(folder, old, new):
    """The shipped list with one planted change."""
    text = shipped_path("hardware/parts.csv", "").read_text(encoding="utf-8")
    assert text.count(old) == 1
    path = folder / "parts.csv"
    path.write_text(text.replace(old, new), encoding="utf-8")
    return path


def test_small_list_rolls_up_as_by_hand(tmp_path):
    """100 + 2 * 5 = 110 g; (100 * 40 - 10 * 160) / 110 = 21.818 mm; 50 + 5 + 14 = 69 dollars; no
    option counts.
    """
    whole = roll_up(read(tmp_path))
    assert whole.mass == pytest.approx(0.110, rel=1e-12)
    assert whole.x_cg == pytest.approx(0.0218182, rel=1e-5)
    assert whole.moment == pytest.approx(0.0024, rel=1e-12)
    assert whole.costs["aircraft"] == pytest.approx(69.0) and whole.cost == pytest.approx(69.0)
    assert whole.unpriced == ("desk",)


def test_option_takes_the_place_of_its_part(tmp_path):
    """By hand: 130 g and (4000 - 4800) / 130 = -6.154 mm."""
    whole = roll_up(with_option(read(tmp_path), "lens"))
    assert whole.mass == pytest.approx(0.130, rel=1e-12)
    assert whole.x_cg == pytest.approx(-0.00615385, rel=1e-5)


def test_moved_battery_brings_the_balance_back(tmp_path):
    """By hand 110 * (40 - 21.818) / 20 = 100 mm; a cell there, no longer inside, balances it."""
    items = read(tmp_path)
    assert balance_move(items, "cell", 0.040) == pytest.approx(0.100, rel=1e-9)
    body, cell, *others = items
    there = [
        replace(body, unit_mass=0.080, x=(4.0 + 0.2) / 80.0),
        replace(cell, inside="", x=0.090),
        *others,
    ]
    assert roll_up(there).x_cg == pytest.approx(0.040, rel=1e-9)


def test_shipped_masses_sum_as_by_hand():
    """137 + 9 + 2.4 + 1.2 + 0.7 + 0.2 + 1.3 + 2 * 0.15 + 0.6 = 152.7 g; the moments of the rows sum
    to 5031.9 g mm: 4932 + 108 + 38.4 - 24 - 14 - 4 - 19.5 + 3.6 + 11.4.
    """
    whole = roll_up(load_parts())
    assert whole.mass == pytest.approx(0.1527, abs=1e-9)
    assert whole.moment == pytest.approx(5031.9e-6, abs=1e-10)


def test_shipped_costs_sum_as_by_hand():
    """Aircraft 180 + 15 + 35 + 0.2 + 0.5 + 0.4 + 0.1 + 2 + 2 * 0.1 + 1, ground 380 + 50 + 6 + 30 +
    15 + 25 + 35 + 10, tools 35 + 10 + 15 + 25 + 40 + 1 + 6, spares 80 + 2 * 8 + 3 * 15.
    """
    costs = roll_up(load_parts()).costs
    assert costs == pytest.approx(
        {"aircraft": 234.4, "ground": 551.0, "tools": 132.0, "spares": 141.0}
    )


def test_papers_own_sum_does_not_close():
    """Paper, hardware section: 137, 9 and 5 g and a receiver of 13.5 g; stated are 150 g."""
    sums = paper_sums(load_parts())
    assert sums[0] == ("137 + 9 + 5 g as printed", pytest.approx(0.151))
    assert sums[1] == ("the same if receiver is not inside airframe", pytest.approx(0.1645))
    assert sums[2][1] == pytest.approx(0.151 + 0.018)


def test_list_airframe_and_cameras_agree():
    """Three files tell of the same camera: its mass and the paper's parts."""
    items, airframe = {item.id: item for item in load_parts()}, load_airframe()
    assert items["camera_analog"].unit_mass == pytest.approx(load_camera("analog").mass_g / 1000.0)
    assert items["camera_digital"].unit_mass == pytest.approx(
        load_camera("digital").mass_g / 1000.0
    )
    paper = {
        "airframe": "airframe",
        "receiver": "receiver",
        "camera": "camera_analog",
        "camera bracket": "bracket",
    }
    for part in airframe.parts:
        assert items[paper[part.name]].paper_mass == pytest.approx(part.mass)
        assert items[paper[part.name]].inside == part.inside


@pytest.mark.parametrize(
    ("old", "new", "text"),
    [
        (
            "receiver,Spektrum receiver with flight controller and gyro,1,13.5",
            "receiver,receiver,1,15.3",
            "13.5 g",
        ),
        ("1,9,paper,12", "1,19,paper,12", "camera_analog: mass: expected the paper's"),
        ("1,,,,80,paper,spares", "1,,,,60,paper,spares", "price: expected the paper's"),
        ("1,1.2,estimate", "1,,estimate", "unit_mass_g of a part that flies"),
        ("1,1.2,estimate", "1,-1.2,estimate", "unit_mass_g"),
        ("1,1.2,estimate", "1,heavy,estimate", "unit_mass_g"),
        ("1,1.2,estimate", "1,1.2,guess", "mass_source"),
        ("measure yours,-15", "measure yours,", "x_mm of a part that flies"),
        ("aircraft,airframe,,13.5 g", "aircraft,fuselage,,13.5 g", "'fuselage'"),
        ("option,,camera_analog", "option,,", "replaces"),
        ("trainer_lead,", "trainer_board,", "every id once"),
        ("tools,,,,the bracket", "shed,,,,the bracket", "used_in"),
        (",,,9 g,", ",,,nine g,", "paper_value"),
        ("screws,M2 x 5 screw,2,", "screws,M2 x 5 screw,2.5,", "whole quantity"),
        ("price_source", "price_from", "columns"),
        ("estimate: steel,12", "estimate, of steel,12", "cells"),
    ],
)
def test_planted_error_is_one_sentence(tmp_path, old, new, text):
    """One wrong cell of the shipped list at a time; the sentence says which."""
    with pytest.raises(InputError, match=r"parts\.csv") as error:
        load_parts(shipped_with(tmp_path, old, new))
    assert text in str(error.value) and "\n" not in str(error.value)


@pytest.mark.parametrize(
    ("old", "new"), [("1,1.2,", "1,12,"), ("printed in PLA,1,", "printed in PLA,2,")]
)
def test_planted_mass_changes_the_sum(tmp_path, old, new):
    """What the reader cannot know to be wrong moves the sums, so the tests by hand above see it."""
    whole = roll_up(load_parts(shipped_with(tmp_path, old, new)))
    assert abs(whole.mass - 0.1527) > 0.002 and abs(whole.moment - 5031.9e-6) > 2e-5


def test_nothing_that_flies_has_no_balance(tmp_path):
    """No mass, no centre of gravity; an unknown option or mover is named."""
    items = read(tmp_path)
    with pytest.raises(InputError, match="at least one part"):
        roll_up([item for item in items if item.used_in == "ground"])
    with pytest.raises(InputError, match="id of an option"):
        with_option(items, "eye")
    with pytest.raises(InputError, match="'wing'"):
        balance_move(items, "wing", 0.0)
    with pytest.raises(InputError, match="without one"):
        balance_move(items, "desk", 0.0)
