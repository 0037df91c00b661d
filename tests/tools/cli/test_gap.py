"""falconwing gap: exit codes, files only where asked for, one sentence for what cannot be used."""

import json
from dataclasses import replace

import numpy as np
import pytest

from falconwing_kit.core.flight_table import slice_time, write_flight_table
from falconwing_kit.data import data_path
from falconwing_kit.tools.cli.main import main
from falconwing_kit.tools.reports import gap_report as report
from tests.gap.studies import shipped, wind_study

CALM, FLIGHT = data_path("case08_calm.csv"), data_path("case08_flight.csv")


def run(calm, flight, out, *more: str) -> int:
    """The command as typed."""
    return main(["gap", "--calm", str(calm), "--flight", str(flight), "--out", str(out), *more])


@pytest.mark.parametrize(
    ("verdict", "code"), [("named", 0), ("none", 0), ("ambiguous", 1), ("outside", 1)]
)
def test_exit_code_says_whether_there_is_an_answer(tmp_path, monkeypatch, capsys, verdict, code):
    """DESIGN.md, section 6: 0 done, 1 the answer is no. The study itself is made once for all
    tests.
    """
    study = wind_study()
    kept = {"named": 1, "ambiguous": 2}.get(verdict, 0)
    naming = replace(study.naming, verdict=verdict, chosen=study.naming.ranking[:kept])
    monkeypatch.setattr(report, "study_gap", lambda *how: replace(study, naming=naming))
    assert run(CALM, FLIGHT, tmp_path / "new" / "out") == code
    said = capsys.readouterr().out
    assert f"verdict: {verdict}" in said
    assert said.splitlines()[-1].startswith("next: ")
    assert [path.name for path in tmp_path.iterdir()] == ["new"]


def test_json_is_the_record(tmp_path, monkeypatch, capsys):
    """What is printed and what is written agree."""
    monkeypatch.setattr(report, "study_gap", lambda *how: wind_study())
    assert run(CALM, FLIGHT, tmp_path, "--json") == 0
    printed = json.loads(capsys.readouterr().out)
    written = json.loads((tmp_path / "report.json").read_text())
    assert printed["effects"] == written["effects"] == ["wind"]
    assert printed["gap"] == pytest.approx(written["gap"])


def test_flights_that_cannot_be_used_are_wrong_use(tmp_path, capsys):
    """Exit code 2, one sentence, nothing written."""
    good = shipped("case08_flight")
    bad = {
        "at least 20 s": slice_time(good, 0.0, 12.0),
        "expected poses": replace(good, p_world=np.full_like(good.p_world, np.nan)),
        "sticks that move": replace(good, commands=np.full_like(good.commands, 0.3)),
        "one rate": replace(good, t=2.0 * good.t),
    }
    path = tmp_path / "bad.csv"
    for words, table in bad.items():
        write_flight_table(path, table)
        assert run(CALM, path, tmp_path / "out") == 2, words
        said = capsys.readouterr().err.strip().splitlines()[-1]
        assert words in said
        assert said.startswith("falconwing: ")
        assert not (tmp_path / "out").exists()
    write_flight_table(path, good)
    header, *lines = path.read_text().splitlines()
    path.write_text("\n".join([header, *reversed(lines)]))  # time runs backwards
    assert run(CALM, path, tmp_path / "out") == 2
    assert len(capsys.readouterr().err.strip().splitlines()) == 1


def test_missing_flight_and_a_file_in_place_of_the_folder_are_wrong_use(tmp_path, capsys):
    """Both are found before anything is computed."""
    assert run(CALM, tmp_path / "no.csv", tmp_path / "out") == 2
    assert "no.csv" in capsys.readouterr().err
    (tmp_path / "taken").write_text("")
    assert run(CALM, FLIGHT, tmp_path / "taken") == 2
    assert "expected a folder" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("EFFECTS = [\n", "line 1: expected Python"),
        ("import numpy\n", "line 1: expected EFFECTS = "),
        (
            "from falconwing_kit.aircraft import CATALOGUE\n\nEFFECTS = CATALOGUE[:1]\n",
            "'wind': expected a new name",
        ),
    ],
)
def test_a_wrong_file_of_effects_is_wrong_use(text, words, tmp_path, capsys):
    """Exit code 2, one sentence with file and line after the line that calls it a program; nothing
    written.
    """
    path = tmp_path / "my_effect.py"
    path.write_text(text)
    assert run(CALM, FLIGHT, tmp_path / "out", "--effects", str(path)) == 2
    notice, refusal = capsys.readouterr().err.strip().splitlines()
    assert "my_effect.py is a program: it runs now, with all your rights" in notice
    assert refusal.startswith("falconwing: my_effect.py, line ") and words in refusal
    assert not (tmp_path / "out").exists()
    assert run(CALM, FLIGHT, tmp_path / "out", "--effects", str(tmp_path / "no.py")) == 2
