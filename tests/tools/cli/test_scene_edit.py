"""`falconwing scene edit`: steps in order, an aircraft that stands where it was told, one sentence
for the rest.
"""

import json

import numpy as np
import pytest
import tyro
from scipy.spatial import cKDTree

from falconwing_kit.core.checks import InputError
from falconwing_kit.core.frames import pose_matrix, rotation_world_body
from falconwing_kit.scene import GaussianScene
from falconwing_kit.scene.arena import leader_at
from falconwing_kit.tools.cli.scene_edit import Edit, parse_step


@pytest.fixture(autouse=True)
def in_empty_folder(tmp_path, monkeypatch):
    """Whatever the verb writes by mistake lands here and is seen."""
    monkeypatch.chdir(tmp_path)


def saved(name, means, labels, names):
    """A file of balls of 10 cm in one grey, and the scene in it."""
    count = len(means)
    sh = np.full((count, 1, 3), 0.5)
    scene = GaussianScene(
        means, [[1, 0, 0, 0]] * count, np.full((count, 3), 0.1), [0.9] * count, sh, labels, names
    )
    scene.save(name)
    return scene


@pytest.fixture
def hall(tmp_path):
    """Two balls of a wall and one of a pad."""
    return saved("hall.npz", [[0, 0, 1], [4, 0, 1], [2, -2, 0]], [0, 0, 1], ("wall", "pad"))


@pytest.fixture
def plane(tmp_path):
    """An aircraft in body axes: nose at +x, right wing tip at +y, wheel at +z, and its tail."""
    return saved(
        "plane.npz", [[0.2, 0, 0], [0, 0.35, 0], [0, 0, 0.1], [-0.3, 0, 0]], [0] * 4, ("leader",)
    )


def edit(capsys, *words):
    """The record that the verb prints, and the scene that it wrote."""
    verb = tyro.cli(
        Edit, args=[*words, "--out", "new.npz", "--json"], config=(tyro.conf.FlagCreatePairsOff,)
    )
    assert verb.run() == 0
    return json.loads(capsys.readouterr().out), GaussianScene.load("new.npz")


def test_what_hangs_in_the_air_is_taken_out_and_the_rest_written_small(tmp_path, capsys):
    """Of 2,000 balls those of a box go, as counted by hand; the rest stays to a millimetre, in half
    the bytes.
    """
    rng = np.random.default_rng(0)
    means = rng.uniform((-5.0, -5.0, 0.0), (5.0, 5.0, 4.0), (2000, 3))
    saved("room.npz", means, [0] * 2000, ("rest",))
    inside = ((means > (-4.0, -4.0, 2.0)) & (means < (4.0, 4.0, 3.0))).all(axis=1)
    words = ("room.npz", "--box=-4,-4,2,4,4,3", "--delete")
    edit(capsys, *words)
    large = (tmp_path / "new.npz").stat().st_size
    record, scene = edit(capsys, *words, "--small")
    assert (
        record["steps"][0]["gaussians"] == inside.sum()
        and (tmp_path / "new.npz").stat().st_size < 0.5 * large
    )
    assert (
        len(scene) == (~inside).sum() and cKDTree(scene.means).query(means[~inside])[0].max() < 1e-3
    )
    with pytest.raises(InputError, match="--small: expected --out to end in"):
        tyro.cli(
            Edit,
            args=[*words, "--small", "--out", "new.ply"],
            config=(tyro.conf.FlagCreatePairsOff,),
        ).run()


def test_an_aircraft_is_added_level_where_it_is_told(hall, plane, capsys):
    """By hand: level, its nose points along x, the right wing to -y, the wheels down, its centre of
    gravity at p.
    """
    words = ("--add", "plane.npz", "--label", "leader", "--translate=-6,-2,1.5")
    record, scene = edit(capsys, "hall.npz", *words)
    placed = scene.means[scene.labelled("aircraft")]
    expected = [[-5.8, -2, 1.5], [-6, -2.35, 1.5], [-6, -2, 1.4], [-6.3, -2, 1.5]]
    np.testing.assert_allclose(placed, expected, atol=1e-6)
    assert (
        record["steps"][0]["did"] == ["add", "translate"]
        and record["scene"]["labels"]["aircraft"] == 4
    )
    assert record["before"] == 3 and record["scene"]["gaussians"] == 7


def test_an_aircraft_stands_as_the_leader_would_at_that_pose(hall, plane, capsys):
    """`leader_at`, by which flights place it: the same pose gives the same Gaussians."""
    angles = np.deg2rad([20.0, 5.0, -30.0])
    _, scene = edit(
        capsys, "hall.npz", "--add", "plane.npz", "--translate=3,1,2", "--rotate-deg", "20,5,-30"
    )
    expected = leader_at(
        plane, pose_matrix(rotation_world_body(*angles), np.array([3.0, 1.0, 2.0]))
    )
    np.testing.assert_allclose(scene.means[scene.labelled("aircraft")], expected.means, atol=1e-6)


def test_an_aircraft_that_is_only_resized_still_waits_to_be_placed(hall, plane, capsys):
    """By hand: in body axes, about the centre of gravity, and still called leader."""
    _, scene = edit(capsys, "hall.npz", "--add", "plane.npz", "--scale", "2")
    np.testing.assert_allclose(scene.means[scene.labelled("leader")], 2.0 * plane.means, atol=1e-6)


def test_steps_come_in_their_order(hall, capsys):
    """By hand: the pad's copy stands at 1 m, is renamed, then all of its kind is shifted, and the
    wall goes.
    """
    record, scene = edit(
        capsys,
        "hall.npz",
        "--label",
        "pad",
        "--duplicate",
        "--name",
        "mat",
        "--translate",
        "0,0,1",
        "--then",
        "label=mat translate=1,0,0 scale=3",
        "--then",
        "label=wall delete",
    )
    assert scene.label_names == ("pad", "mat") and len(scene) == 2
    np.testing.assert_allclose(scene.means, [[2, -2, 0], [3, -2, 1]], atol=1e-6)
    np.testing.assert_allclose(scene.scales, [[0.1] * 3, [0.3] * 3], rtol=1e-6)
    assert [step["did"] for step in record["steps"]] == [
        ["duplicate", "rename", "translate"],
        ["scale", "translate"],
        ["delete"],
    ]


def test_a_part_turns_about_its_middle_or_about_a_place(hall, capsys):
    """By hand: yaw is nose right, so 90 deg takes what is ahead (x = 4) to the right (y = -2) of
    the middle (2, 0).
    """
    _, scene = edit(capsys, "hall.npz", "--label", "wall", "--rotate-deg", "0,0,90")
    np.testing.assert_allclose(scene.means[:2], [[2, 2, 1], [2, -2, 1]], atol=1e-6)
    _, scene = edit(
        capsys, "hall.npz", "--label", "wall", "--rotate-deg", "0,0,90", "--about", "0,0,1"
    )
    np.testing.assert_allclose(scene.means[:2], [[0, 0, 1], [0, -4, 1]], atol=1e-6)


def test_light_and_noise_come_on_what_is_in_the_box(hall, capsys):
    """By hand: (1/2 + C0/2)(1/4)^(1/2.2) in the box; all of it black or white with noise on all."""
    box = ("--box=-1,-1,0,1,1,2",)
    record, scene = edit(capsys, "hall.npz", *box, "--brightness", "0.25")
    rgb = 0.5 + 0.28209479 * scene.sh[:, 0]
    np.testing.assert_allclose(
        rgb, np.outer([0.25 ** (1 / 2.2), 1, 1], np.full(3, 0.5 + 0.141047396)), atol=1e-6
    )
    assert record["steps"][0]["relight"] == {"brightness": 0.25, "gain": [1.0, 1.0, 1.0]}
    _, noisy = edit(capsys, "hall.npz", *box, "--salt-pepper", "1", "--seed", "2")
    grey = 0.5 + 0.28209479 * noisy.sh[:, 0]
    assert np.isin(np.round(grey[0], 6), (0.0, 1.0)).all() and np.allclose(
        grey[1:], 0.5 + 0.141047396
    )


def test_randomise_is_told_and_repeats(hall, capsys):
    """The drawn look stands in the record; the same seed writes the same bits, and another one
    others.
    """
    runs = [
        edit(capsys, "hall.npz", "--label", "wall", "--randomise", "--seed", seed)
        for seed in ("4", "4", "5")
    ]
    look = runs[0][0]["steps"][0]["randomise"]
    assert 0.5 <= look["scale"] <= 2.0 and set(look) == {"scale", "brightness", "salt_pepper"}
    np.testing.assert_allclose(np.ptp(runs[0][1].means[:2, 0]), 4.0 * look["scale"], rtol=1e-5)
    assert np.array_equal(runs[0][1].sh, runs[1][1].sh) and not np.array_equal(
        runs[0][1].scales, runs[2][1].scales
    )


def test_a_table_and_what_to_do_next(hall, capsys):
    """One row a step; the last line is a command."""
    assert Edit(scene="hall.npz", label="pad", scale=2.0, out="new.ply").run() == 0
    lines = capsys.readouterr().out.splitlines()
    assert ["pad", "1", "scale"] in [line.split() for line in lines]
    assert lines[-1].startswith("next: falconwing render new.ply")


@pytest.mark.parametrize(
    ("words", "text"),
    [
        ({}, "--label"),
        ({"label": "wall"}, "expected a change"),
        ({"label": "wall", "delete": True, "scale": 2.0}, "--delete"),
        ({"add": "plane.npz", "duplicate": True}, "--duplicate"),
        ({"label": "roof", "delete": True}, "wall, pad"),
        ({"box": "0,0,0,1,1", "delete": True}, "--box: expected 6 numbers"),
        ({"box": "8,8,8,9,9,9", "delete": True}, "got none"),
        ({"label": "pad", "translate": "1,2,up"}, "--translate: expected 3 numbers"),
        ({"label": "pad", "translate": "1,2,nan"}, "--translate: expected 3 numbers"),
        ({"label": "pad", "rotate_deg": "10"}, "--rotate-deg: expected 3 numbers"),
        ({"label": "pad", "scale": -1.0}, "factor"),
        ({"label": "pad", "gain": "1,1,-1"}, "gain"),
        ({"label": "pad", "brightness": -1.0}, "--brightness"),
        ({"label": "pad", "salt_pepper": 2.0}, "share"),
        ({"add": "plain.ply"}, "give it a name"),
        ({"add": "stadium"}, "a name that ships"),
        ({"add": "plane.npz", "name": "wall"}, "new to the scene, got 'wall'"),
        ({"add": "plane.npz", "name": "leader", "translate": "1,0,0"}, "another name"),
        ({"label": "wall", "scale": 2.0, "then": ("label='wall delete",)}, "--then"),
        ({"label": "wall", "scale": 2.0, "out": "new.txt"}, ".npz or .ply"),
    ],
)
def test_wrong_use_is_one_sentence_and_writes_nothing(hall, plane, words, text, tmp_path):
    """The sentence names what was wrong; no file appears."""
    plane.save("plain.ply")
    before = sorted(path.name for path in tmp_path.iterdir())
    with pytest.raises(InputError) as told:
        Edit(**({"scene": "hall.npz", "out": tmp_path / "new.npz"} | words)).run()
    assert text in str(told.value) and "\n" not in str(told.value)
    assert sorted(path.name for path in tmp_path.iterdir()) == before


def test_missing_files_and_options(hall, tmp_path):
    """A path that leads nowhere, a folder that is none, an option that is none."""
    with pytest.raises(FileNotFoundError, match=r"nowhere\.npz"):
        Edit(scene="hall.npz", add="nowhere.npz", out=tmp_path / "new.npz").run()
    with pytest.raises(FileNotFoundError, match="deep"):
        Edit(scene="hall.npz", label="pad", scale=2.0, out=tmp_path / "deep" / "new.npz").run()
    with pytest.raises(SystemExit) as end:
        parse_step("label=pad sclae=2")
    assert end.value.code == 2
