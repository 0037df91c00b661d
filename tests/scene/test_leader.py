"""The leader that ships: its size by the tape, its looks by the path-traced turntable photos it was
trained on.
"""

from pathlib import Path

import numpy as np
import pytest

from falconwing_kit.core.frames import pose_matrix, rotation_world_body
from falconwing_kit.scene import GaussianScene, PinholeCamera, load_scene, nose_camera_pose, render
from falconwing_kit.scene.arena import leader_at, with_leader
from falconwing_kit.scene.edit import move, scale

TURNTABLE = Path(__file__).parents[3] / "shared" / "data" / "hall" / "aircraft"


@pytest.fixture(scope="module")
def leader():
    return load_scene("leader")


def test_it_has_the_tapes_size(leader):
    """0.70 m span and 0.52 m long by the tape; ends of Gaussians are accurate to 1 and 3 cm. All
    are labelled.
    """
    nose, tail, right, left = (
        leader.points[name] for name in ("nose", "tail", "right_wing_tip", "left_wing_tip")
    )
    assert np.linalg.norm(right - left) == pytest.approx(0.70, abs=0.01)
    assert np.linalg.norm(nose - tail) == pytest.approx(0.52, abs=0.03)
    assert leader.labelled("leader").all() and len(leader) < 5001 and "path-traced" in leader.source


def test_its_axes_are_the_bodys(leader):
    """By what an aircraft is: nose ahead, right wing to the right, the fin's top (least z) behind
    the wing.
    """
    assert leader.points["nose"][0] > 0.1 and leader.points["tail"][0] < -0.2
    assert leader.points["right_wing_tip"][1] > 0.3 > -0.3 > leader.points["left_wing_tip"][1]
    solid = leader.means[leader.opacities > 0.5]
    assert solid[solid[:, 2].argmin(), 0] < leader.points["right_wing_tip"][0]


@pytest.mark.skipif(
    not TURNTABLE.is_dir(), reason="wants the path-traced turntable photos of the shared data"
)
def test_it_looks_like_a_photo_it_did_not_learn(leader):
    """Photo 028 was held out. On black, 37 dB is what the worst of nine had; a mirrored wing would
    leave about 20.
    """
    from falconwing_kit.tools.capture.fit import CENTRE_OF_GRAVITY
    from falconwing_kit.tools.capture.training.turntable import load_turntable

    photos = load_turntable(TURNTABLE, CENTRE_OF_GRAVITY)
    row = photos.names.index("028.png")
    T = photos.Ts_world_camera[row].numpy().astype(float)
    left, _, right = np.linalg.svd(T[:3, :3])
    drawn = render(leader, photos.camera, pose_matrix(left @ right, T[:3, 3]))
    alpha = photos.alphas[row].numpy() / 255.0
    photo = photos.images[row].numpy() / 255.0  # on black already
    error = drawn.rgb - photo
    assert -10.0 * np.log10((error**2).mean()) > 35.0
    assert np.abs(drawn.alpha - alpha).mean() < 0.01


def test_named_points_go_where_the_aircraft_goes(leader, tmp_path):
    """By hand: the nose lies at T nose. Saved, they come back; in a hall, where parts move by
    themselves, they go.
    """
    T = pose_matrix(rotation_world_body(0.3, -0.1, 0.8), np.array([3.0, -2.0, 1.5]))
    everything = np.ones(len(leader), bool)
    moved = move(leader, everything, T)
    assert moved.points["nose"] == pytest.approx(
        T[:3, :3] @ leader.points["nose"] + T[:3, 3], abs=1e-5
    )
    twice = scale(leader, everything, 2.0, np.zeros(3))
    assert twice.points["left_wing_tip"] == pytest.approx(
        2.0 * leader.points["left_wing_tip"], abs=1e-6
    )
    moved.save(tmp_path / "a.npz")
    again = GaussianScene.load(tmp_path / "a.npz")
    assert {name: place.tolist() for name, place in again.points.items()} == {
        name: place.tolist() for name, place in moved.points.items()
    }
    assert GaussianScene.joined(leader, leader).points == {}


def test_a_hall_without_one_gets_one_at_the_given_pose(leader):
    """A pixel of the leader's middle, by projection, is covered by Gaussians called leader and by
    no others.
    """
    floor = GaussianScene(
        [[0, 0, -50]], [[1, 0, 0, 0]], [[1, 1, 1]], [0.9], [[[0, 0, 0]]], (), ("floor",)
    )
    T_world_leader = pose_matrix(rotation_world_body(0.0, 0.0, 0.0), np.array([2.0, 0.3, 1.0]))
    scene = leader_at(with_leader(floor), T_world_leader)
    camera, T_world_camera = (
        PinholeCamera.from_fov_deg(160, 120, 60.0),
        nose_camera_pose((0.0, 0.0, 1.0), 0, 0, 0),
    )
    (pixel,), _ = camera.project(np.array([[2.0, 0.3, 1.0]]), T_world_camera)
    alone = render(scene.selected(scene.labelled("leader")), camera, T_world_camera)
    assert alone.alpha[int(pixel[1]), int(pixel[0])] > 0.9
    assert np.allclose(alone.alpha, render(scene, camera, T_world_camera).alpha, atol=0.02)
    assert scene.labelled("leader").sum() == len(leader)
