"""The hall that ships was trained on photos of a path-traced hall: small enough, in the kit's
world, good to fly in.
"""

from importlib.resources import files

import numpy as np
import pytest

from falconwing_kit.aircraft.touchdown import LandingPad
from falconwing_kit.scene import PinholeCamera, load_scene, nose_camera_pose, render
from falconwing_kit.scene.analog import scene_link

CAMERA = PinholeCamera.from_fov_deg(640, 480, 77.8)  # the lens of the hall's flights
MARKER = np.array([0.0, 0.0, 0.75])  # its centre, by the hall's survey [m]


@pytest.fixture(scope="module")
def hall():
    return load_scene("hall")


def test_it_is_small_and_labelled(hall):
    """The limits: 200,000 Gaussians and 8 MB."""
    assert 150_000 < len(hall) <= 200_000
    assert files("falconwing_kit.data").joinpath("hall.npz").stat().st_size < 8_000_000
    assert set(hall.label_names) == {"rest", "floor", "pad", "marker"}
    assert "path-traced" in hall.source


def test_the_analog_hall_is_the_same_hall_seen_through_a_link(hall):
    """The same Gaussians; the link is the one of analog.toml, and no other scene has one."""
    analog = load_scene("hall_analog")
    assert (analog.means == hall.means).all() and (analog.sh == hall.sh).all()
    assert scene_link("hall_analog").snr_db == 38.7
    assert all(scene_link(name) is None for name in ("arena", "hall", "leader", "hall.npz"))


@pytest.mark.parametrize(("distance", "side"), [(3.0, -0.4), (4.0, 0.0), (5.0, 0.3), (6.0, -0.3)])
def test_the_marker_is_where_the_tape_says(hall, distance, side):
    """OpenCV finds it in the view, and its place in the camera is that of the survey to 5 %: the
    world is the kit's.
    """
    import cv2

    p_world = np.array([-distance * np.cos(side), distance * np.sin(side), 1.1])
    T_world_camera = nose_camera_pose(p_world, 0.0, -0.03, side)
    grey = cv2.cvtColor(
        (255.0 * render(hall, CAMERA, T_world_camera).rgb).astype(np.uint8), cv2.COLOR_RGB2GRAY
    )
    dictionary = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_4X4_50)
    corners, ids, _ = cv2.aruco.ArucoDetector(dictionary).detectMarkers(grey)
    assert ids is not None and ids.ravel().tolist() == [7]
    square = 0.4 * np.array(
        [[-1.0, 1.0, 0.0], [1.0, 1.0, 0.0], [1.0, -1.0, 0.0], [-1.0, -1.0, 0.0]]
    )
    image = corners[0].reshape(4, 2).astype(float) + 0.5
    _, _, p_camera = cv2.solvePnP(square, image, CAMERA.K, None, flags=cv2.SOLVEPNP_IPPE_SQUARE)
    expected = (MARKER - p_world) @ T_world_camera[:3, :3]
    assert np.linalg.norm(p_camera.ravel() - expected) < 0.05 * np.linalg.norm(expected)


def test_the_pad_is_where_aircraft_land(hall):
    """Its Gaussians lie on the surveyed pad, 13 x 2 m from x = 1 on and 10 cm high, and look blue
    from above.
    """
    pad, means = LandingPad(), hall.means[hall.labelled("pad")]
    sides = [pad.y_centre - 1.0, pad.y_centre + 1.0]
    assert np.quantile(means[:, 1], [0.02, 0.98]) == pytest.approx(sides, abs=0.3)
    assert np.quantile(means[:, 0], [0.02, 0.98]) == pytest.approx([1.0, 14.0], abs=0.3)
    rgb = (
        render(hall, CAMERA, nose_camera_pose((4.0, -2.0, 2.5), 0.0, -0.8, 0.0))
        .rgb[220:260, 300:340]
        .mean((0, 1))
    )
    assert rgb[2] > 1.5 * rgb[0] and rgb[2] > 1.2 * rgb[1]


def test_the_shipped_pose_net_localises_in_this_hall(hall):
    """Renders from places of an approach, whose poses are known; on average within a metre and 5
    deg of heading.
    """
    from falconwing_kit.vision import PoseNet

    net, off, turned = PoseNet.load("hall"), [], []
    for x, y, z, yaw in (
        (-16.0, -1.5, 1.6, 0.05),
        (-12.0, -2.4, 1.5, -0.05),
        (-9.0, -1.0, 1.2, 0.0),
    ):
        T_world_camera = nose_camera_pose((x, y, z), 0.05, -0.05, yaw)
        found = net.estimate(np.uint8(255.0 * render(hall, CAMERA, T_world_camera).rgb), CAMERA)
        off.append(np.linalg.norm(found.T_world_camera[:3, 3] - T_world_camera[:3, 3]))
        ahead, seen = T_world_camera[:3, 2], found.T_world_camera[:3, 2]
        turned.append(np.degrees(np.arccos(np.clip(ahead @ seen, -1.0, 1.0))))
        assert found.sigma_position > 0.0 and found.sigma_attitude > 0.0
    assert np.mean(off) < 1.0 and np.mean(turned) < 5.0
