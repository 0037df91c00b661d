"""`falconwing scene export` writes what other viewers read, and says what the format loses."""

import json

import numpy as np
import pytest

from falconwing_kit.scene import GaussianScene
from falconwing_kit.tools.cli.main import main


@pytest.fixture(autouse=True)
def balls(tmp_path, monkeypatch):
    """Two balls, a red and a blue one, in a folder that is empty otherwise."""
    monkeypatch.chdir(tmp_path)
    sh = (np.array([[[0.9, 0.1, 0.1]], [[0.1, 0.1, 0.9]]]) - 0.5) / 0.28209479
    GaussianScene(
        [[2, 0, 1], [2, -1, 1]], [[1, 0, 0, 0]] * 2, np.full((2, 3), 0.1), [0.99, 0.99], sh,
        [0, 1], ("red", "blue"), "by hand",
    ).save("b.npz")  # fmt: skip


@pytest.mark.parametrize("to", ["splat", "spz", "sog"])
def test_a_written_scene_is_read_again(to, tmp_path, capsys):
    """Into a folder under the scene's name; the record has its size and what was lost."""
    assert main(["scene", "export", "b.npz", "--to", to, "--out", ".", "--json"]) == 0
    record = json.loads(capsys.readouterr().out)
    path = tmp_path / f"b.{to}"
    assert record["bytes"] == path.stat().st_size and record["gaussians"] == 2
    assert any("red, blue" in line for line in record["lost"])
    back = GaussianScene.load(path)
    assert np.allclose(back.means, [[2, 0, 1], [2, -1, 1]], atol=1e-3)


def test_labels_can_be_left_out_and_losses_are_printed(capsys):
    """Only the blue ball is in the file; the last line shows how to look at it."""
    assert main(["scene", "export", "b.npz", "--without", "red", "--out", "c.spz"]) == 0
    printed = capsys.readouterr().out
    assert (
        "lost: labels" in printed
        and printed.splitlines()[-1] == "next: falconwing scene info c.spz"
    )
    assert np.allclose(GaussianScene.load("c.spz").means, [[2, -1, 1]], atol=1e-3)


@pytest.mark.parametrize(
    ("words", "text"),
    [
        (["b.npz", "--out", "c.ply"], ".spz"),
        (["b.npz", "--out", "nowhere/c.spz"], "nowhere"),
        (["b.npz", "--out", ".", "--without", "green"], "green"),
        (["stadium", "--out", "."], "arena, hall"),
        (["nowhere.ply", "--out", "."], "nowhere.ply"),
    ],
)
def test_wrong_use_is_one_sentence_and_nothing_is_written(words, text, capsys, tmp_path):
    """Exit 2."""
    assert main(["scene", "export", *words]) == 2
    printed = capsys.readouterr()
    assert text in printed.err and printed.err.count("\n") == 1 and printed.out == ""
    assert [path.name for path in tmp_path.iterdir()] == ["b.npz"]


def test_the_scene_itself_is_kept(capsys):
    """Exporting a .spz onto itself would round it again."""
    assert main(["scene", "export", "b.npz", "--out", "."]) == 0
    assert main(["scene", "export", "b.spz", "--out", "."]) == 2
    assert "own" in capsys.readouterr().err
