"""The scene that a page loads: its size, what it leaves out, and the scene with fewer Gaussians."""

import gzip

import numpy as np
import pytest

from falconwing_kit.core.checks import InputError
from falconwing_kit.scene import (
    GaussianScene,
    PinholeCamera,
    leader_at,
    load_scene,
    nose_camera_pose,
    render,
)
from falconwing_kit.tools.classroom.scene_file import scene_bytes, thinned
from tests.tools.classroom.splat_page import PAGE

CAMERA = PinholeCamera.from_fov_deg(240, 180, 77.8)
VIEWS = [nose_camera_pose((x, y, 1.5), 0.1, -0.05, 0.1) for x, y in ((-19, 0), (-6, -2))]


def load(tmp_path, data):
    """A scene from the bytes that a page loads."""
    (tmp_path / "a.spz").write_bytes(gzip.compress(data, 1))
    return GaussianScene.load(tmp_path / "a.spz")


def psnr(a, b):
    return -10.0 * np.log10(np.mean((a - b) ** 2))


@pytest.mark.parametrize(("name", "most"), [("arena", 1_500_000), ("hall", 4_600_000)])
def test_page_and_scene_are_small_enough_to_send(name, most):
    """The limits of issue and manual: scene and every script of the page, packed by gzip."""
    sent = len(gzip.compress(scene_bytes(load_scene(name)), 6))
    scripts = sum(len(gzip.compress(path.read_bytes(), 6)) for path in PAGE.glob("*.*"))
    assert sent + scripts < most


@pytest.mark.parametrize("name", ["arena", "hall"])
def test_what_is_sent_looks_like_the_scene(name, tmp_path):
    """30 dB is asked for; the rounding leaves more than 40. The arena's leader is not sent."""
    scene = load_scene(name)
    if "leader" in scene.label_names:
        scene = leader_at(scene, None)
    sent = load(tmp_path, scene_bytes(load_scene(name)))
    assert len(sent) == len(scene)
    for pose in VIEWS:
        assert psnr(render(sent, CAMERA, pose).rgb, render(scene, CAMERA, pose).rgb) > 40.0


def test_a_scene_of_nothing_but_a_leader_keeps_it():
    """Its 4,000 Gaussians or so: the label alone does not empty a scene."""
    leader = load_scene("leader")
    count = int.from_bytes(scene_bytes(leader)[8:12], "little")
    assert count == len(leader)


def test_higher_harmonics_are_left_out(tmp_path):
    """The page draws degree 1: the rest would be sent for nothing."""
    sh = np.arange(48.0).reshape(1, 16, 3) / 100.0
    sent = load(
        tmp_path, scene_bytes(GaussianScene([[0, 0, 0]], [[1, 0, 0, 0]], [[1] * 3], [1], sh))
    )
    assert sent.sh.shape == (1, 4, 3) and np.abs(sent.sh - sh[:, :4]).max() < 0.04


def test_two_equal_tiles_become_one_by_hand():
    """Two tiles of opacity 0.3 side by side along x: the mean is in the middle, the variance along
    x is 1 + 1. The weight of both is 0.6; the opacity stays 0.3, so the area becomes 2.
    """
    sh = np.full((2, 1, 3), 0.3)
    pair = GaussianScene(
        [[-1, 5, 0], [1, 5, 0]], [[1, 0, 0, 0]] * 2, [[1, 1, 0.001]] * 2, [0.3, 0.3], sh
    )
    one = thinned(pair, 1)
    assert len(one) == 1 and np.allclose(one.means, [[0, 5, 0]], atol=1e-6)
    assert one.opacities[0] == pytest.approx(0.3, rel=1e-5)
    assert np.sort(one.scales[0])[1:].prod() == pytest.approx(2.0, rel=1e-3)
    _, short, long = np.sort(one.scales[0])
    assert long / short == pytest.approx(np.sqrt(2.0), rel=1e-3)
    assert np.allclose(one.sh, 0.3)


def test_unlike_neighbours_stay_apart():
    """Four tiles in a row, red red blue blue: of two, one is red and one is blue."""
    sh = np.zeros((4, 1, 3))
    sh[:2, 0, 0], sh[2:, 0, 2] = 1.7, 1.7
    row = GaussianScene(
        [[x, 0, 0] for x in (0, 1, 5, 6)], [[1, 0, 0, 0]] * 4, [[0.5, 0.5, 0.01]] * 4, [0.9] * 4, sh
    )
    two = thinned(row, 2)
    assert len(two) == 2 and np.allclose(np.sort(two.means[:, 0]), [0.5, 5.5], atol=1e-5)
    assert np.allclose(np.sort(two.sh[:, 0, 0]), [0.0, 1.7], atol=1e-5)


def test_a_thinned_arena_still_looks_like_it():
    """As asked for, and 30 dB with 100,000 of 174,000; the smaller scene is not changed."""
    arena = leader_at(load_scene("arena"), None)
    few = thinned(arena, 100_000)
    assert len(few) == 100_000 and thinned(few, 100_000) is few
    for pose in VIEWS:
        assert psnr(render(few, CAMERA, pose).rgb, render(arena, CAMERA, pose).rgb) > 30.0
    assert len(scene_bytes(arena, 30_000)) == 16 + 20 * 30_000


def test_fewer_than_one_is_refused():
    """By name."""
    with pytest.raises(InputError, match="max_gaussians"):
        scene_bytes(load_scene("leader"), 0)
