"""falconwing eval: the whole chain on tiny images, its files, and what is refused."""

import json

import pytest

from falconwing_kit.tools.cli.main import main


def test_a_toy_evaluation_writes_records_and_tables(tmp_path, capsys):
    """Two trials of expert and pose pilot, images of 64x48. The expert lands both from the paper's
    starts; a second run flies nothing; the paper's 15 cm stand beside.
    """
    words = ["eval", "--pilots", "expert,pose", "--task", "landing", "--trials", "2", "--size",
             "64x48", "--worlds", "paper", "--out", str(tmp_path / "out")]  # fmt: skip
    assert main(words) == 0
    out = capsys.readouterr().out
    assert "SIMULATED: landing" in out and "next: open" in out
    expert = next(line.split() for line in out.splitlines() if line.startswith("expert  paper"))
    assert expert[2:5] == ["2", "of", "2"] and "15 cm" in out
    records = tmp_path / "out" / "trials.jsonl"
    lines = records.read_text().splitlines()
    assert len(lines) == 1 + 2 * 2
    by_image = [json.loads(line) for line in lines[1:]]
    assert {r["images"] for r in by_image if r["pilot"] == "pose"} == {"64x48 images by 'fast'"}
    assert all(r["supervisor"]["reason"] == "" for r in by_image if r["pilot"] == "expert")
    for name in ("index.html", "tables.md", "summary.jsonl"):
        assert (tmp_path / "out" / name).stat().st_size > 500
    assert main([*words, "--json"]) == 0
    assert records.read_text().splitlines() == lines
    found = json.loads(capsys.readouterr().out)
    assert found["trials_flown"] == found["of"] == 4
    assert [row["pilot"] for row in found["tables"]["Landing"]] == ["expert", "pose"]


@pytest.mark.parametrize(
    ("words", "sentence"),
    [
        (("--pilots", "rgbx"), "pilot: expected one of"),
        (("--pilots", "manual"), "expected pilots that fly by themselves"),
        (("--pilots", "expert_pid", "--task", "follow"), "expected one that flies the task follow"),
        (("--worlds", "moon"), "--worlds: expected tables, sweeps, all"),
        (("--scene", "moon"), "--scene moon: expected hall or arena"),
        (("--trials", "0"), "--trials"),
        (("--size", "8x8"), "--size"),
        (("--minutes", "0"), "--minutes"),
        (("--workers", "0"), "--workers"),
    ],
)
def test_wrong_options_get_one_sentence(words, sentence, tmp_path, capsys):
    """Exit 2 before the first trial, and nothing is written."""
    assert main(["eval", *words, "--out", str(tmp_path / "out")]) == 2
    error = capsys.readouterr().err
    assert sentence in error and len(error.splitlines()) == 1
    assert not (tmp_path / "out").exists()


def test_worlds_are_shown(capsys):
    """Every group on a line, with its worlds."""
    assert main(["eval", "--show"]) == 0
    out = capsys.readouterr().out
    assert "delay 150" in out and "right_turn_sharp_climb" in out and "reality" in out
