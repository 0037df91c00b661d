"""`falconwing export`: from a flight log to a table or a repaired log, by its words on the command line."""

import json
import shutil

import numpy as np
import pytest

from falconwing_kit.cli.main import main
from falconwing_kit.core.flight_log import FlightLogWriter, read_flight_log
from falconwing_kit.core.flight_table import read_flight_table
from falconwing_kit.core.messages import Command, Image, State


@pytest.fixture
def log(tmp_path):
    """Ten frames, each command with its own throttle; beside it the log as it stands in mid-flight."""
    path = tmp_path / "flight.mcap"
    with FlightLogWriter(path) as writer:
        for k in range(10):
            writer.state(0.05 * k, State.from_vector(np.arange(9.0) / 10.0 + k / 100.0), image_sequence=k)
            writer.command(
                0.05 * k + 0.03, Command(0.1 * k, 0.0, 0.0, 0.0, k), Image(k, 0.05 * k, np.zeros(9, np.uint8))
            )
        shutil.copy(path, tmp_path / "interrupted.mcap")
    return path


def test_a_log_becomes_a_table(log, tmp_path, capsys):
    """Ten rows with their poses and commands; the last line says what to type next."""
    assert main(["export", str(log), "--out", str(tmp_path / "flight.csv")]) == 0
    table = read_flight_table(tmp_path / "flight.csv")
    assert table.commands[:, 0] == pytest.approx([0.1 * k for k in range(10)]) and table.has_pose.all()
    assert capsys.readouterr().out.splitlines()[-1].startswith("next: falconwing identify")


def test_an_interrupted_log_becomes_a_whole_one(log, tmp_path, capsys):
    """All that was recorded is there, the interruption is said, and the new log has none."""
    (tmp_path / "saved").mkdir()
    assert (
        main(["export", str(tmp_path / "interrupted.mcap"), "--to", "mcap", "--out", str(tmp_path / "saved"), "--json"])
        == 0
    )
    report = json.loads(capsys.readouterr().out)
    saved = read_flight_log(tmp_path / "saved" / "interrupted.mcap")
    assert report["command"] == len(saved.commands) == 10 and "closing record" in report["warnings"][0]
    assert saved.warnings == ()


@pytest.mark.parametrize(
    ("words", "sentence"),
    [
        (["absent.mcap", "--out", "a.csv"], "absent.mcap"),
        (["flight.mcap", "--out", "flight.mcap"], "another name"),
        (["flight.mcap", "--out", "none/a.csv"], "want a folder"),
        (["notes.txt", "--out", "a.csv"], "want a flight log in MCAP format"),
    ],
)
def test_wrong_use_is_one_sentence_and_exit_2(log, tmp_path, monkeypatch, capsys, words, sentence):
    """Nothing is written and the log is as before."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "notes.txt").write_text("no log")
    before = sorted(tmp_path.iterdir())
    assert main(["export", *words]) == 2
    error = capsys.readouterr().err
    assert sentence in error and error.count("\n") == 1
    assert sorted(tmp_path.iterdir()) == before
    assert len(read_flight_log(log).commands) == 10
