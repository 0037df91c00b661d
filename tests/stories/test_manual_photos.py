"""The chapter "Photos to simulator" is true: its commands run in order on the shipped stand-in."""

import json
import re
import shlex
import shutil
from pathlib import Path

import numpy as np
import pytest

from falconwing_kit.scene import GaussianScene, load_scene, scene_link
from falconwing_kit.tools.capture.photo_files import read_reconstruction
from falconwing_kit.tools.cli.main import main

ROOT = Path(__file__).resolve().parents[2]
CHAPTER = (ROOT / "manual" / "photos_to_simulator.md").read_text(encoding="utf-8")
COMMANDS = [
    line
    for block in re.findall(r"^```sh\n(.*?)^```", CHAPTER, re.M | re.S)
    for line in block.splitlines()
]


def test_every_path_leads_somewhere():
    """Files and folders of the repository that the chapter names."""
    paths = re.findall(r"(?:falconwing_kit|tests|manual)/[\w./]*\w", CHAPTER)
    assert len(paths) > 8 and [path for path in paths if not (ROOT / path).exists()] == []


@pytest.mark.timeout(900)
def test_commands_run_in_their_order(tmp_path, monkeypatch, capsys):
    """Typed as printed, in a folder with what the repository has: each says 0, and what it promised
    is there.
    """
    for name in ("falconwing_kit/data/hall_clip", "tests/data/hall24"):
        shutil.copytree(ROOT / name, tmp_path / name)
    monkeypatch.chdir(tmp_path)
    assert len(COMMANDS) >= 10
    for line in COMMANDS:
        program, *words = shlex.split(line)
        assert program == "falconwing"
        assert (line, main(words)) == (line, 0)
        if "--out" in words:
            assert Path(words[words.index("--out") + 1]).exists(), line
    capsys.readouterr()
    scene = GaussianScene.load("room_scene/scene.npz")
    assert 100 < len(scene) <= 2000 and {"pad", "marker"} <= set(scene.label_names)
    assert Path("room_aligned/alignment.png").is_file() and any(Path("room_scene/pairs").iterdir())
    check_both_trainings()


def check_both_trainings():
    """The second knows what the first held out, and stands on poses that the first moved by less
    than 10 cm.

    From miniature photos no pose is bettered; 10 cm, ten times the tape's error, tell a small step
    from a lost camera.
    """
    first, second = (
        json.loads(Path(name, "figures.json").read_text()) for name in ("room_first", "room_scene")
    )
    assert first["photos"]["held_out"] == second["photos"]["held_out"] != []
    assert first["settings"]["poses"] and not second["settings"]["poses"]
    before, after = (
        read_reconstruction(Path(name)) for name in ("room_aligned", "room_first/corrected")
    )
    assert before.names == after.names
    moved = np.linalg.norm(before.T_world_camera[:, :3, 3] - after.T_world_camera[:, :3, 3], axis=1)
    assert 0.0 < moved.max() < 0.1


def test_python_of_the_chapter_is_there():
    """The names that it tells."""
    assert set(load_scene("leader").points) == {"nose", "tail", "left_wing_tip", "right_wing_tip"}
    assert callable(scene_link("hall_analog").apply)
