"""`falconwing scene` builds scenes and tells what is in them; `falconwing render` makes the image
one asked for.
"""

import json

import cv2
import numpy as np
import pytest

from falconwing_kit.core.frames import pose_matrix, rotation_world_body
from falconwing_kit.scene import GaussianScene, PinholeCamera, nose_camera_pose, render
from falconwing_kit.scene.arena import leader_at, load_scene
from falconwing_kit.tools.cli.main import main


@pytest.fixture(autouse=True)
def in_empty_folder(tmp_path, monkeypatch):
    """Whatever a verb writes by mistake lands here and is seen."""
    monkeypatch.chdir(tmp_path)


@pytest.fixture
def balls(tmp_path):
    """Two balls of 10 cm: a red one 2 m ahead of the origin, a blue one 1 m to the right of it."""
    rgb = np.array([[0.9, 0.1, 0.1], [0.1, 0.1, 0.9]])
    sh = (rgb[:, None] - 0.5) / 0.28209479
    means, turn = [[2, 0, 1], [2, -1, 1]], [[1, 0, 0, 0]] * 2
    GaussianScene(
        means, turn, np.full((2, 3), 0.1), [0.99, 0.99], sh, [0, 1], ("red", "blue"), "by hand"
    ).save("b.npz")
    return "b.npz"


def run_json(capsys, *words):
    """The record that a verb prints."""
    assert main([*words, "--json"]) == 0
    return json.loads(capsys.readouterr().out)


def test_info_counts_labels_and_bounds(balls, capsys):
    """By hand, from the two balls."""
    record = run_json(capsys, "scene", "info", balls)
    assert (record["gaussians"], record["labels"], record["sh_degree"]) == (
        2,
        {"red": 1, "blue": 1},
        0,
    )
    assert (record["low_m"], record["high_m"], record["source"]) == (
        [2.0, -1.0, 1.0],
        [2.0, 0.0, 1.0],
        "by hand",
    )


def test_info_prints_a_table(balls, capsys):
    """The count stands beside its label; the last line says what to do next."""
    assert main(["scene", "info", balls]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert ["blue", "1"] in [line.split() for line in lines] and lines[-1].startswith(
        "next: falconwing render b.npz"
    )


def test_build_writes_a_scene_that_info_reads(tmp_path, capsys):
    """The file holds what was printed; the seed stands in its source."""
    built = run_json(capsys, "scene", "build", "--seed", "3", "--out", str(tmp_path))
    assert [path.name for path in tmp_path.iterdir()] == ["arena.npz"]
    assert run_json(capsys, "scene", "info", "arena.npz") == built
    assert built["source"].endswith("seed 3") and {"pad", "marker", "leader"} <= set(
        built["labels"]
    )


@pytest.mark.parametrize(("yaw", "blue", "dark"), [("0", 75, 25), ("26.565", 50, 75)])
def test_image_shows_the_scene_at_its_pose(balls, yaw, blue, dark):
    """By hand: 90 deg, so f = 50; the blue ball is at u = 50 + 50 / 2 = 75, and atan(1 / 2) nose
    right ahead at 50.
    """
    words = [f"--pose=0,0,1,0,0,{yaw}", "--size", "100x60", "--fov-deg", "90", "--out", "v.png"]
    assert main(["render", balls, *words]) == 0
    image = cv2.imread("v.png")  # OpenCV reads blue, green, red
    assert image.shape == (60, 100, 3)
    assert (
        image[30, blue].argmax() == 0 and image[30, blue].max() > 200 and image[30, dark].max() == 0
    )


def test_depth_and_alpha_are_images_too(balls, capsys):
    """The red ball is 2000 mm away and hides 99 % at its middle; where nothing is both are 0."""
    words = [
        "--pose",
        "0,0,1,0,0,0",
        "--size",
        "101x61",
        "--depth",
        "d.png",
        "--alpha",
        "a.png",
        "--out",
        "v.png",
    ]
    assert main(["render", balls, *words]) == 0
    depth, alpha = (cv2.imread(name, cv2.IMREAD_UNCHANGED) for name in ("d.png", "a.png"))
    assert depth.dtype == np.uint16 and alpha.dtype == np.uint8
    assert depth[30, 50] == pytest.approx(2000, abs=2) and alpha[30, 50] == pytest.approx(
        0.99 * 255, abs=1.5
    )
    assert depth[5, 5] == 0 and alpha[5, 5] == 0


def test_backends_agree(balls):
    """Two implementations of the same equations; one step of 255."""
    images = []
    for backend in ("fast", "reference"):
        words = [
            "--pose",
            "0,0.2,1,10,2,5",
            "--size",
            "64x48",
            "--backend",
            backend,
            "--out",
            f"{backend}.png",
        ]
        assert main(["render", balls, *words]) == 0
        images.append(cv2.imread(f"{backend}.png").astype(int))
    assert np.abs(images[0] - images[1]).max() <= 1 and images[0].max() > 100


def test_arena_is_rendered_without_its_leader_unless_it_is_placed(tmp_path, monkeypatch):
    """The image equals that of the scene put together by hand: the hall alone, or the leader at the
    pose given.
    """
    monkeypatch.setattr("falconwing_kit.scene.arena.cache_folder", lambda: tmp_path)
    camera, T_world_camera = (
        PinholeCamera.from_fov_deg(80, 60, 77.8),
        nose_camera_pose((-9, -2, 1.5), 0, 0, 0),
    )
    T_world_leader = pose_matrix(
        rotation_world_body(*np.deg2rad([20, 5, -10])), np.array([-7.5, -2.0, 1.5])
    )
    for words, pose in (([], None), (["--leader", "-7.5,-2,1.5,20,5,-10"], T_world_leader)):
        assert (
            main(
                [
                    "render",
                    "arena",
                    "--pose",
                    "-9,-2,1.5,0,0,0",
                    "--size",
                    "80x60",
                    *words,
                    "--out",
                    "v.png",
                ]
            )
            == 0
        )
        expected = 255.0 * render(leader_at(load_scene("arena"), pose), camera, T_world_camera).rgb
        assert np.abs(cv2.imread("v.png")[..., ::-1] - expected).max() <= 0.51


def test_a_hall_without_a_leader_gets_the_one_that_ships(balls):
    """The image equals that of balls and trained leader put together by hand; without --leader
    there is none.
    """
    camera, T_world_camera = (
        PinholeCamera.from_fov_deg(80, 60, 77.8),
        nose_camera_pose((0, 0, 1), 0, 0, 0),
    )
    T_world_leader = pose_matrix(rotation_world_body(0.1, 0.0, 0.2), np.array([1.5, 0.4, 1.1]))
    leader = leader_at(
        GaussianScene.joined(GaussianScene.load(balls), load_scene("leader")), T_world_leader
    )
    words = ["render", balls, "--pose", "0,0,1,0,0,0", "--size", "80x60", "--out", "v.png"]
    pose = f"1.5,0.4,1.1,{np.degrees(0.1)},0,{np.degrees(0.2)}"
    for more, scene in (([], GaussianScene.load(balls)), ([f"--leader={pose}"], leader)):
        assert main([*words, *more]) == 0
        expected = 255.0 * render(scene, camera, T_world_camera).rgb
        assert np.abs(cv2.imread("v.png")[..., ::-1] - expected).max() <= 0.51


def test_the_analog_hall_is_the_hall_through_its_link():
    """38.7 dB are 3 grey levels of rms noise; a seed gives its picture again and another seed
    another.
    """
    words = ["--pose=-12,0.5,1.5,0,-3,0", "--size", "320x240"]
    pictures = []
    for scene, more in (
        ("hall", ()),
        ("hall_analog", ()),
        ("hall_analog", ()),
        ("hall_analog", ("--seed", "5")),
    ):
        assert main(["render", scene, *words, *more, "--out", "v.png"]) == 0
        pictures.append(cv2.imread("v.png").astype(float) @ (0.114, 0.587, 0.299))
    clean, noisy, again, other = pictures
    flat = np.abs(cv2.Laplacian(cv2.GaussianBlur(clean, (0, 0), 2.0), cv2.CV_64F)) < 0.3
    assert np.std((noisy - clean)[flat]) == pytest.approx(255.0 * 10 ** (-38.7 / 20.0), rel=0.3)
    assert (noisy == again).all() and (noisy != other).mean() > 0.5


@pytest.mark.parametrize(
    ("words", "text"),
    [
        (["--pose", "0,0,0,0,0"], "--pose"),
        (["--pose", "0,0,0,0,0,up"], "--pose"),
        (["--pose", "0,0,0,0,0,nan"], "--pose"),
        (["--size", "640"], "--size"),
        (["--size", "0x480"], "width"),
        (["--size", "99999x99999"], "width"),
        (["--size", "-6x4"], "--size"),
        (["--fov-deg", "180"], "fov_deg"),
        (["--leader", "1,2"], "--leader"),
        (["--out", "v.jpg"], ".png"),
        (["--out", "nowhere/v.png"], "nowhere"),
        (["--depth", "v.png"], "--depth"),
    ],
)
def test_wrong_use_is_one_sentence_and_exit_two(balls, words, text, capsys, tmp_path):
    """The sentence names what was wrong; nothing is printed as a result and nothing is written."""
    options = {"--pose": "0,0,1,0,0,0", "--size": "8x6", "--out": "v.png"} | dict(
        zip(words[::2], words[1::2], strict=True)
    )
    assert main(["render", balls, *(f"{name}={value}" for name, value in options.items())]) == 2
    printed = capsys.readouterr()
    assert text in printed.err and printed.err.count("\n") == 1 and printed.out == ""
    assert [path.name for path in tmp_path.iterdir()] == ["b.npz"]


@pytest.mark.parametrize(
    ("words", "text"),
    [
        (["info", "stadium"], "arena, hall, hall_analog, leader"),
        (["info", "nowhere.ply"], "nowhere.ply"),
        (["info", "."], "."),
        (["build", "--seed", "-1"], "seed"),
        (["build", "--out", "nowhere/a.npz"], "nowhere"),
        (["build", "--out", "a.txt"], ".npz"),
    ],
)
def test_a_scene_that_is_none_is_one_sentence(words, text, capsys, tmp_path):
    """As above, for `scene`."""
    assert main(["scene", *words]) == 2
    printed = capsys.readouterr()
    assert text in printed.err and printed.err.count("\n") == 1 and printed.out == ""
    assert list(tmp_path.iterdir()) == []
