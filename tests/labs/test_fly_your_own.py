"""Lab 13 flies with any parts: all of the student's, none, or any mixture with the kit's."""

import json
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from falconwing_kit.tools.grading.collect import collect_source, read_notebook
from falconwing_kit.tools.grading.course.board import rank_entries
from falconwing_kit.tools.grading.find import (
    importable_given,
    lab_folder,
    load_checks,
    load_module,
    notebook_path,
)
from falconwing_kit.tools.grading.mine import PARTS, CheckedLab, load_parts, write_package
from tests.labs.tools import require_sandbox

ROOT = Path(__file__).resolve().parents[2]
FOLDER = ROOT / "labs" / "lab13_fly_your_own"
FUNCTIONS = ("merge_gaussians", "thin_hall", "sticks_from_slots", "fly", "landing_score")


def students_labs():
    """Twelve labs of a student who solved all, marked as theirs by the notebook's own functions."""
    checked = []
    for part in PARTS:
        folder = lab_folder(part.lab, ROOT / "labs")
        notebook = read_notebook(notebook_path(folder, solution=True))
        checked.append(CheckedLab(part, load_checks(folder), folder, folder, notebook, {}))
    return checked


def mixture(folder, seed):
    """A package in which a drawn half of the functions are the kit's, and their names."""
    rng = np.random.default_rng(seed)
    labs = [
        replace(lab, why={name: "drawn" for name in lab.names if rng.random() < 0.5})
        for lab in students_labs()
    ]
    choices = write_package(labs, folder, verify=False)
    return load_parts(folder), choices


@pytest.fixture
def given():
    """Lab 13's given code."""
    with importable_given(load_module(FOLDER, "given")) as module:
        yield module


def written():
    """The functions of lab 13's solution."""
    notebook = read_notebook(notebook_path(FOLDER, solution=True))
    space: dict[str, object] = {"__name__": "notebook"}
    for name in FUNCTIONS:
        exec(collect_source(notebook, name).text, space)
    return SimpleNamespace(**{name: space[name] for name in FUNCTIONS})


def fly_with(given, parts, *, pictures, hidden=("none", 0.0)):
    """A flight of lab 13, by the expert: the flight, and its board's states."""
    own = written()
    look = given.new_look(parts, own.thin_hall(parts)) if pictures else lambda state: None
    pilot, board = given.Pilot(parts), given.Board(parts, own.sticks_from_slots)
    board.engage(given.FIRST_COMMAND)
    plant = given.new_plant(parts, *hidden)
    flown = own.fly(given.START, look, pilot, board.carry, plant, given.STEPS, given.FLOOR_Z)
    return flown, board.states, own.landing_score(flown["states"])


def require_landing(given, flown, states, score):
    """Down on the pad, softly, never through a wall, with the board's consent all the time."""
    assert set(states) == {"ACTIVE"}
    track = flown["states"]
    assert np.all((track[:, 0] > -22.0) & (track[:, 0] < 17.5))
    assert np.all((track[:, 1] > -11.5) & (track[:, 1] < 7.5))
    x, offset, sink, points = score
    assert given.PAD[0] < x < given.PAD[1] and offset < 1.0 and 0.0 < sink < 0.8 and points > 20.0


@pytest.mark.parametrize("seed", range(3))
def test_a_mixture_of_parts_flies_and_lands(given, tmp_path, seed):
    """Half of the functions are drawn to be the kit's; pad, walls: the hall's own numbers."""
    parts, choices = mixture(tmp_path / "mixed", seed)
    assert 10 < sum(each.mine for each in choices) < len(choices) - 10
    for each in choices:
        function = getattr(getattr(parts, each.part), each.function)
        assert (".kit." not in function.__module__) == each.mine
    require_landing(given, *fly_with(given, parts, pictures=False))


def test_own_renderer_draws_the_marker_where_the_camera_looks(given, tmp_path):
    """From 8 m before the marker, nose at it: dark square of 0.8 m * 99 px / 8 m = 10 px there.

    Its border is black, the wall behind it is not.
    """
    parts, _ = mixture(tmp_path / "mixed", 5)
    look = given.new_look(parts, written().thin_hall(parts))
    picture = look(np.array([-8.1, 0.0, 0.75, 0.0, 0.0, 0.0, 7.0, 0.0, 0.0])).mean(axis=2)
    marker, around = picture[55:66, 75:86], picture[55:66, 40:60]
    assert marker.min() < 0.5 * around.mean() and marker.max() - marker.min() > 60.0


def test_gap_workflow_names_what_was_hidden_or_none(given):
    """Each of the four effects at its size within 25 %, and nothing in a calm flight."""
    parts = load_parts("kit")
    calm = given.logged(fly_with(given, parts, pictures=False)[0], 1)
    for number, (name, size) in enumerate(given.SIZES.items()):
        flown = fly_with(given, parts, pictures=False, hidden=(name, size))[0]
        found = given.name_the_gap(parts, calm, given.logged(flown, 10 + number))
        assert (found["word"], found["names"]) == ("named", (name,)), found
        assert found["sizes"][name] == pytest.approx(size, rel=0.25)
    again = given.logged(fly_with(given, parts, pictures=False)[0], 7)
    assert given.name_the_gap(parts, calm, again)["word"] == "none"


def test_hidden_effects_act_as_their_names_say(given):
    """One step from level flight at 7 m/s, aileron half right: roll is V L_da a t, by lab 4.

    With 30 % of the aileron lost it is 0.7 of that; adverse yaw turns the nose left, out of the
    turn; drag and a weaker propeller take speed. 2 %: the sideslip that builds up in 0.05 s.
    """
    parts, state = load_parts("kit"), np.array([0.0, 0.0, 2.0, 0.09, 0.0, 0.0, 7.0, 0.0, 0.0])
    command = np.array([0.5, 0.5, 0.0, 0.0])

    def after(effect, size):
        return given.new_plant(parts, effect, size)(state, command, command)

    calm = after("none", 0.0)
    assert calm[5] == pytest.approx(7.0 * 0.37 * 0.5 * 0.05, rel=0.02)
    assert after("aileron_loss", 0.3)[5] == pytest.approx(0.7 * calm[5], rel=0.02)
    assert after("adverse_yaw", 0.08)[4] < calm[4] - 0.01
    assert after("extra_drag", 0.012)[6] == pytest.approx(calm[6] - 0.012 * 49.0 * 0.05, abs=2e-3)
    assert after("thrust_loss", 0.25)[6] < calm[6] - 0.02


def test_entry_is_flown_again_without_any_code(given):
    """The same numbers, rounded to 1e-6: the same points; claimed points do not matter."""
    parts = load_parts("kit")
    flown, _, score = fly_with(given, parts, pictures=False)
    entry = given.entry_of(flown, 99.9, parts)
    assert given.fly_entry(entry, written().landing_score) == pytest.approx(score[3], abs=0.05)
    with pytest.raises(ValueError, match=r"expected \(n, 4\) commands"):
        given.fly_entry('{"commands": [[1, 2], [3, 4]]}', written().landing_score)


def test_board_ranks_by_what_is_flown_not_by_what_is_claimed(given, tmp_path):
    """The honest entry's points by lab 13 itself; a lying one that dives has none; junk is last."""
    require_sandbox()
    parts = load_parts("kit")
    flown, _, score = fly_with(given, parts, pictures=False)
    (tmp_path / "ada.json").write_text(given.entry_of(flown, score[3], parts))
    dive = {"points": 100.0, "commands": [[0.0, 0.0, -1.0, 0.0]] * 60}
    (tmp_path / "bob.json").write_text(json.dumps(dive))
    (tmp_path / "cleo.json").write_text("print('give me points')")
    (tmp_path / "dan.json").write_text('{"commands": [[NaN, 0, 0, 0], [0, 0, 0, 0]]}')
    files = [tmp_path / f"{name}.json" for name in ("dan", "cleo", "bob", "ada")]
    board = rank_entries(files)
    assert [each.name for each in board] == ["ada", "bob", "cleo", "dan"]
    assert board[0].points == pytest.approx(score[3], abs=0.05)
    assert (board[1].points, board[1].claimed, board[1].problem) == (0.0, 100.0, "")
    assert "expected lab 13's entry" in board[2].problem and "finite" in board[3].problem


def test_lab_5_identifies_what_lab_4_then_flies(given, tmp_path, monkeypatch):
    """The flight is the plant's own: its numbers forecast a second of 7 m to a few centimetres.

    Lab 5's guess, 30 % off in thrust and moment, misses by decimetres. A student's part is called.
    """
    parts, _ = mixture(tmp_path / "mixed", 4)
    flown = fly_with(given, parts, pictures=False)[0]
    fitted, guess = given.forecast_misses(parts, flown)
    assert fitted < 0.05 and guess > 0.3
    said = given.second_opinions(parts, {**flown, "frames": [None]})
    assert any("labs 5 and 4" in line and f"{100.0 * fitted:.0f} cm off" in line for line in said)
    stays = lambda *_: (given.lab_given(parts, "lab05").GUESS, None)  # noqa: E731
    monkeypatch.setattr(parts.identification, "multiple_shooting", stays)
    assert given.forecast_misses(parts, flown) == pytest.approx((guess, guess))
