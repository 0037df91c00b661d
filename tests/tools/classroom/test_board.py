"""The leaderboard: judged logs only, one row a name, kept over restarts and damage."""

import json
from dataclasses import replace
from pathlib import Path

import pytest

from falconwing_kit.core.checks import InputError
from falconwing_kit.tools.classroom.board import FILE, LONGEST_NAME, Board, nickname
from falconwing_kit.tools.classroom.results import FlightRecord, Score, Verdict, judge
from tests.tools.classroom.flights import edit_log, fly_log

RECORD = FlightRecord(1, Path("x.mcap"), "landing", "", "arena", 10_000, "expert", (), ())


def landed(name: str, cm: float, sink: float = 0.3) -> Verdict:
    return Verdict("on the pad", True, {}, (Score(name, "landing", cm, "cm", (sink, "m/s")),))


def lock(name: str, seconds: float) -> Verdict:
    return Verdict("in view", False, {}, (Score(name, "follow", seconds, "s"),))


def test_nearest_to_the_line_and_longest_lock_are_first(tmp_path):
    """Fewer centimetres are better, more seconds are better; equal ones by the sink rate."""
    board = Board(tmp_path)
    for name, cm, sink in (("A", 8.0, 0.3), ("B", 2.0, 0.5), ("C", 2.0, 0.2)):
        board.add(RECORD, landed(name, cm, sink))
    for name, seconds in (("A", 3.0), ("B", 7.0)):
        board.add(RECORD, lock(name, seconds))
    assert [row["name"] for row in board.rows("landing")] == ["C", "B", "A"]
    assert [row["name"] for row in board.rows("follow")] == ["B", "A"]
    assert board.rows()[0]["second"] == 0.2


def test_one_row_a_name_and_the_best_stays(tmp_path):
    """A worse flight changes nothing, a better one replaces; "mia" is "Mia"."""
    board = Board(tmp_path)
    board.add(RECORD, landed("Mia", 5.0))
    assert "stays 5 cm of flight 1" in board.add(replace(RECORD, number=2), landed("mia", 9.0))
    board.add(replace(RECORD, number=3), landed("Mia", 1.0))
    (row,) = board.rows()
    assert (row["score"], row["flight"]) == (1.0, 3)


def test_board_survives_a_restart(tmp_path):
    """The same folder, another object."""
    Board(tmp_path).add(RECORD, landed("Mia", 5.0))
    again = Board(tmp_path)
    assert again.rows() == Board(tmp_path).rows() and again.rows()[0]["name"] == "Mia"
    assert again.damage == ""


@pytest.mark.parametrize(
    "content",
    [
        b"{", b"[]", b'{"version": 9, "rows": []}', b"\xff\xfe",
        b'{"version": 1, "rows": [{"name": 3}]}',
        b'{"version": 1, "rows": [{"name": "a", "task": "landing", "score": "0", "unit": "cm",'
        b' "flight": 1}]}',
        b"[" * 100_000,
    ],
)  # fmt: skip
def test_a_damaged_file_is_kept_aside_and_said_once(tmp_path, content):
    """One sentence; the file stays under another name; the new board works."""
    (tmp_path / FILE).write_bytes(content)
    board = Board(tmp_path)
    assert "kept as board_damaged_" in board.damage and board.rows() == []
    (kept,) = tmp_path.glob("board_damaged_*")
    assert kept.read_bytes() == content
    board.add(RECORD, landed("Mia", 5.0))
    assert json.loads((tmp_path / FILE).read_text())["rows"][0]["name"] == "Mia"


def test_names_are_one_short_visible_line():
    """No line breaks, no control characters, no more than 24 characters."""
    assert nickname("  Mia\n\u202eevil\x00 ") == "Mia evil"
    assert len(nickname("x" * 1000)) == LONGEST_NAME
    assert nickname("\n\t") == ""


def test_flights_without_a_student_or_a_name_are_no_row(tmp_path):
    """The autopilot is not on the board."""
    board = Board(tmp_path)
    assert "no student" in board.add(RECORD, Verdict("on the pad", True, {}))
    board.add(RECORD, landed("\n", 1.0))
    board.add(RECORD, landed("Mia", float("nan")))
    assert board.rows() == []


def test_a_changed_log_has_no_row(tmp_path):
    """From a real log to the board; the same log with other sticks is refused with a sentence."""
    record, _ = fly_log(tmp_path / "x.mcap", hands=[(0.0, "student", "Mia")])
    board = Board(tmp_path / "board")
    assert "Mia" in board.add(record, judge(record))

    def better(topic, values):
        if topic == "/command":
            values["rudder"] = min(1.0, values["rudder"] + 0.2)

    edited = replace(record, log=edit_log(record.log, tmp_path / "y.mcap", better), number=2)
    assert "the log was changed" in board.add(edited, judge(edited))
    assert [row["flight"] for row in board.rows()] == [1]


def test_a_folder_that_is_a_file_is_one_sentence(tmp_path):
    """Choose another one."""
    (tmp_path / "x").write_text("")
    with pytest.raises(InputError, match="choose another"):
        Board(tmp_path / "x")
