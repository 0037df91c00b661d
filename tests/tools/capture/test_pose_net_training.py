"""Pose net training in miniature: files -> net and errors, its command, and what it refuses."""

import json
from dataclasses import replace

import numpy as np
import pytest
from PIL import Image

from falconwing_kit.core.checks import InputError
from falconwing_kit.learning.pose_net_loop import TrainSchedule
from falconwing_kit.learning.pose_views import aircraft_poses
from falconwing_kit.scene import load_scene
from falconwing_kit.tools.capture import pose_net_training
from falconwing_kit.tools.capture.pose_net_training import PoseNetConfig, train_pose_net
from falconwing_kit.tools.cli.main import main
from falconwing_kit.vision.pose_net import PoseNet
from tests.learning.halls import CAMERA, HIGH, LOW, hall, write_photos

PLAN = TrainSchedule(steps=4, minutes=5.0, batch=4, fresh=4, pool=40, first=8)
SMALL = {"plan": PLAN, "width": 64, "features": 16, "layers": 1, "heads": 1, "box": (*LOW, *HIGH)}


@pytest.fixture(scope="module")
def files(tmp_path_factory):
    """A scene, a leader and twenty photos with poses."""
    folder = tmp_path_factory.mktemp("hall")
    hall().save(folder / "hall.npz")
    load_scene("leader").save(folder / "leader.npz")
    write_photos(folder / "aligned", aircraft_poses(LOW, HIGH, 20, np.random.default_rng(0)))
    return folder


def test_one_call_leaves_net_figures_and_a_picture(files, tmp_path, monkeypatch):
    """What the design promises: weights that load, errors on renders and held-out photos, shares in
    stated sigmas.
    """
    monkeypatch.setattr(pose_net_training, "JUDGED_RENDERS", 30)
    job = PoseNetConfig(
        files / "hall.npz",
        files / "aligned",
        tmp_path / "out",
        leader=files / "leader.npz",
        **SMALL,
    )
    report = train_pose_net(job)
    assert json.loads((tmp_path / "out" / "pose_net.json").read_text()) == report
    for name in ("renders", "worse", "photos"):
        assert report[name]["position_m"]["median"] > 0.0
        assert 0.0 <= report[name]["position_in_stated"]["68%"] <= 1.0
    names = {f"{k:03}.png" for k in range(20)}
    held, aside = set(report["photos_held_out"]), set(report["photos_aside"])
    assert held
    assert held | aside <= names
    assert not held & aside
    assert report["photos"]["images"] == len(held)
    assert report["photos_learnt_from"] == 20 - len(held) - len(aside)
    net = PoseNet.load(tmp_path / "out" / "pose_net.safetensors")
    assert net.record.camera == CAMERA
    assert net.record.sigma_scales == pytest.approx(report["sigma_scales"])
    assert net.estimate(np.zeros((48, 64, 3), np.uint8), CAMERA).sigma_position > 0.0
    assert Image.open(tmp_path / "out" / "views.png").size[0] == 6 * 64


def test_a_training_goes_on_from_a_net_and_refuses_one_of_another_hall(
    files, tmp_path, monkeypatch
):
    """With a learning rate of zero nothing is learnt: the weights are those of the net to go on
    from, and not those that another seed draws.
    """
    monkeypatch.setattr(pose_net_training, "JUDGED_RENDERS", 30)
    paths = files / "hall.npz", files / "aligned"
    train_pose_net(PoseNetConfig(*paths, tmp_path / "first", **SMALL))
    first = tmp_path / "first" / "pose_net.safetensors"
    still = SMALL | {"plan": replace(PLAN, rate=0.0, seed=9), "start": first}
    train_pose_net(PoseNetConfig(*paths, tmp_path / "second", **still))
    before, after = (
        dict(PoseNet.load(path).network.named_parameters())
        for path in (first, tmp_path / "second" / "pose_net.safetensors")
    )
    for name, weights in before.items():
        # both are saved in half precision
        assert np.allclose(weights.detach(), after[name].detach(), rtol=2e-3, atol=1e-6), name
    for change, word in (
        ({"features": 32}, "shape"),
        ({"box": (*LOW, *np.add(HIGH, 1.0))}, "high"),
    ):
        with pytest.raises(InputError, match=f"expected a net of {word}"):
            train_pose_net(PoseNetConfig(*paths, tmp_path / "third", **(still | change)))


def test_held_out_photos_can_be_named(files, tmp_path):
    """Lines, JSON with names or a table, and the scene training's own figures: all hold out the
    same two.
    """
    texts = [
        "001.png\n007.png\n",
        '{"held_out": ["001.png", "photos/007.png"]}',
        '[{"photo": "001.png"}, {"photo": "007.png"}]',
    ]
    photos = pose_net_training._aligned_photos(
        PoseNetConfig(files / "hall.npz", files / "aligned", tmp_path)
    )
    texts.append(
        '{"held_out": {"psnr_db": 28.0, "photos": [{"photo": "001.png"}, {"photo": "007.png"}]}}'
    )
    for text in texts:
        (tmp_path / "held").write_text(text)
        held, aside = pose_net_training._split(photos, tmp_path / "held")
        assert np.flatnonzero(held).tolist() == [1, 7]
        assert aside.any()
        assert not (held & aside).any()
    for text in ("none.png", '{"other": 1}', "".join(f"{k:03}.png\n" for k in range(20))):
        (tmp_path / "held").write_text(text)
        with pytest.raises(InputError, match="expected names of"):
            pose_net_training._split(photos, tmp_path / "held")


def test_photos_in_another_world_are_refused(files, tmp_path):
    """Not aligned: their metres are not the hall's."""
    write_photos(
        tmp_path / "raw", aircraft_poses(LOW, HIGH, 4, np.random.default_rng(0)), aligned=False
    )
    with pytest.raises(InputError, match="scene align"):
        train_pose_net(
            PoseNetConfig(files / "hall.npz", tmp_path / "raw", tmp_path / "out", **SMALL)
        )


@pytest.mark.parametrize(
    ("change", "word"),
    [
        ({"backend": "vulkan"}, "backend"),
        ({"width": 100}, "multiple of 16"),
        ({"heads": 3}, "divisor"),
        ({"stem": "gru"}, "stem"),
        ({"box": (0, 0, 0, 1, 1, 1)}, "--box"),
        ({"photo_share": 2.0}, "photo_share"),
    ],
)
def test_options_that_make_no_sense_are_refused(files, tmp_path, change, word):
    """Each before any training, in one sentence, and nothing is written."""
    with pytest.raises(InputError, match=word):
        train_pose_net(
            PoseNetConfig(
                files / "hall.npz", files / "aligned", tmp_path / "out", **(SMALL | change)
            )
        )
    assert not (tmp_path / "out").exists()


def test_scene_pose_net_trains_and_prints_the_errors(files, tmp_path, capsys, monkeypatch):
    """One step, by the command: the same files as by the call, a table, and the next command."""
    monkeypatch.setattr(pose_net_training, "JUDGED_RENDERS", 30)
    sizes = "--width 64 --features 16 --layers 1 --heads 1 --steps 1 --batch 4 --fresh 4 --pool 20"
    words = ["scene", "pose-net", files / "hall.npz", files / "aligned", "--out", tmp_path / "out"]
    box = ["--box", *LOW, *HIGH]
    assert main([*map(str, words), *sizes.split(), "--first", "8", *map(str, box)]) == 0
    printed = capsys.readouterr().out
    assert "held-out photos" in printed
    assert "next: falconwing poses" in printed
    assert json.loads((tmp_path / "out" / "pose_net.json").read_text())["training"]["steps"] == 1
    assert PoseNet.load(tmp_path / "out" / "pose_net.safetensors").record.low == [*LOW]


def test_missing_scene_is_reported_in_one_sentence(files, tmp_path, capsys):
    """Wrong use ends with 2 and one sentence with the missing file."""
    missing, aligned = str(tmp_path / "none.npz"), str(files / "aligned")
    assert main(["scene", "pose-net", missing, aligned, "--out", str(tmp_path / "out")]) == 2
    message = capsys.readouterr().err.strip()
    assert "none.npz" in message
    assert "\n" not in message
