"""Marker pose: corners and poses against geometry drawn by other means, ambiguity, covariance and
refusals.
"""

import cv2
import numpy as np
import pytest

from falconwing_kit.core.checks import InputError
from falconwing_kit.scene.arena import load_scene
from falconwing_kit.scene.camera import PinholeCamera
from falconwing_kit.scene.render import render
from falconwing_kit.vision.marker import (
    CORNER_SIGMA_PX,
    Marker,
    MarkerPose,
    corner_noise,
    find_marker,
    line_and_column_shifts,
    name_markers,
    project_corners,
)
from tests.vision.drawn_marker import CAMERA, pose, view


@pytest.fixture
def rng():
    """A seeded generator."""
    return np.random.default_rng(5)


def area(corners_px):
    """Area of a quadrangle by OpenCV [px^2]."""
    return cv2.contourArea(corners_px.astype(np.float32))


def random_pose(rng):
    """A camera 4 to 13 m before the marker that looks about at it, banked up to 50 deg."""
    distance = rng.uniform(4.0, 13.0)
    y = rng.uniform(-0.6, 0.6) * distance
    yaw = np.degrees(np.arctan2(y, distance)) + rng.uniform(
        -10, 10
    )  # y is left, yaw is positive to the right
    return pose(-distance, y, rng.uniform(0.5, 2.8), rng.uniform(-50, 50), rng.uniform(-8, 8), yaw)


def test_corners_follow_the_pinhole_model():
    """By hand: from 5 m straight ahead 0.80 m is 198.4 x 0.8 / 5 = 31.744 px wide, centred in the
    image.
    """
    corners = project_corners(Marker(), CAMERA, pose(-5.0, 0.0, 0.75))
    half = 31.744 / 2.0
    by_hand = [
        (160 - half, 120 - half),
        (160 + half, 120 - half),
        (160 + half, 120 + half),
        (160 - half, 120 + half),
    ]
    assert corners == pytest.approx(np.array(by_hand), abs=1e-9)


def test_corners_are_found_to_a_tenth_of_a_pixel_and_the_size_to_half_a_percent(rng):
    """Truth is the drawing's own geometry; twenty poses, sharp and soft.

    Tolerance: a tenth of a pixel is half of what OpenCV's own refinement reaches on these images;
        half a percent is
    5 cm at 10 m, less than a pose's sigma. Blending light without gamma makes the marker 1 % too
    small.
    """
    off, size = [], []
    for k in range(60):
        T = random_pose(rng)
        seen = find_marker(view(T, rng, blur_px=(0.0, 0.5, 1.0)[k % 3]), CAMERA)
        true = project_corners(Marker(), CAMERA, T)
        if seen is not None:
            off.append(seen.corners_px - true)
            size.append(np.sqrt(area(seen.corners_px) / area(true)))
    assert len(off) >= 20  # the rest are beyond the border or too soft for the detector
    assert np.sqrt(np.mean(np.square(off))) < 0.1
    assert np.mean(size) == pytest.approx(1.0, abs=0.005)


def test_the_true_pose_lies_within_its_covariance(rng):
    """Of one of the two poses: chi2 with six degrees of freedom has mean 6; the sigma is stated a
    little large.
    """
    chi2 = []
    for _ in range(40):
        T = random_pose(rng)
        seen = find_marker(view(T, rng, noise=4.0), CAMERA)
        if seen is None:
            continue
        turn = [
            cv2.Rodrigues(found[:3, :3] @ T[:3, :3].T)[0].ravel() for found in seen.T_world_camera
        ]
        off = np.concatenate([seen.T_world_camera[:, :3, 3] - T[:3, 3], turn], axis=1)
        chi2.append(
            min(o @ np.linalg.solve(C, o) for o, C in zip(off, seen.covariance, strict=True))
        )
    assert len(chi2) >= 20
    assert np.mean(chi2) < 9.0
    assert np.median(chi2) > 0.1  # and not far too large


def test_covariance_is_that_of_poses_from_noisy_corners(rng):
    """Against OpenCV's iterative solver on corners with drawn noise, 400 times; 15 % for the draw's
    own spread.
    """
    T, marker = pose(-5.0, 2.0, 1.6, 20.0, -5.0, 22.0), Marker()
    seen = find_marker(view(T, rng), CAMERA)
    true = project_corners(marker, CAMERA, T)
    start = np.linalg.inv(T) @ marker.T_world_marker
    turn, place = cv2.Rodrigues(start[:3, :3])[0], start[:3, 3:].copy()
    drawn = []
    for _ in range(400):
        noisy = true + rng.normal(0.0, 0.05, (4, 2))
        _, r, t = cv2.solvePnP(
            marker.corners,
            noisy,
            CAMERA.K,
            None,
            turn.copy(),
            place.copy(),
            True,
            cv2.SOLVEPNP_ITERATIVE,
        )
        R = cv2.Rodrigues(r)[0]
        T_marker_camera = np.block([[R.T, -R.T @ t], [np.zeros((1, 3)), np.ones((1, 1))]])
        found = marker.T_world_marker @ T_marker_camera
        drawn.append(
            [*(found[:3, 3] - T[:3, 3]), *cv2.Rodrigues(found[:3, :3] @ T[:3, :3].T)[0].ravel()]
        )
    stated = np.sqrt(np.diag(seen.covariance[0])) * 0.05 / CORNER_SIGMA_PX
    assert stated == pytest.approx(np.std(drawn, axis=0), rel=0.15)


def test_both_poses_are_kept_the_better_first(rng):
    """From 10 m and 25 deg aside the other pose mirrors the camera's side; both fit to half a
    pixel.
    """
    T = pose(-9.0, 4.2, 1.5, 0.0, 0.0, 25.0)
    seen = find_marker(view(T, rng), CAMERA)
    assert seen.reprojection_px[0] < seen.reprojection_px[1] < 0.5
    assert seen.T_world_camera[0, :3, 3] == pytest.approx(T[:3, 3], abs=0.6)  # three sigma of 0.2 m
    assert seen.T_world_camera[1, 1, 3] == pytest.approx(-4.2, abs=1.0)
    assert seen.T_camera_marker[0] @ np.linalg.inv(Marker().T_world_marker) @ seen.T_world_camera[
        0
    ] == pytest.approx(np.eye(4), abs=1e-9)


def test_corner_noise_follows_from_reprojection_errors(rng):
    """Corners with 0.3 px of drawn noise; the median of 300 draws is good to some 10 %."""
    detections = []
    for _ in range(300):
        T = random_pose(rng)
        noisy = project_corners(Marker(), CAMERA, T) + rng.normal(0.0, 0.3, (4, 2))
        found, _, _, misfit = cv2.solvePnPGeneric(
            Marker().corners, noisy, CAMERA.K, None, flags=cv2.SOLVEPNP_ITERATIVE
        )
        if found:
            none = np.full((2, 4, 4), np.nan)
            detections.append(MarkerPose(noisy, 1.0, none, none, np.ravel(misfit)[[0, 0]], none))
    assert corner_noise(detections) == pytest.approx(0.3, rel=0.2)
    with pytest.raises(InputError, match="at least one detection"):
        corner_noise([])


def test_a_predicted_marker_is_found_in_noise(rng):
    """Noise of 30 grey levels and blur: OpenCV's detector alone finds none of twelve; with a
    prediction nearly all are found.
    """
    alone = near = 0
    for k in range(12):
        T = pose(-7.0 - 0.2 * k, 1.0, 1.2, 3.0 * k, 0.0, 8.0)
        image, true = view(T, rng, noise=30.0, blur_px=1.2), project_corners(Marker(), CAMERA, T)
        alone += find_marker(image, CAMERA) is not None
        seen = find_marker(image, CAMERA, near_px=true + np.array([3.0, -4.0]))
        near += seen is not None and np.abs(seen.corners_px - true).max() < 1.0
    assert alone == 0
    assert near >= 10


def test_no_marker_is_found_where_there_is_none(rng):
    """Noise, and another id, looked for right where they are."""
    T = pose(-6.0, 0.5, 1.0)
    expected = project_corners(Marker(), CAMERA, T)
    empty = rng.integers(0, 255, (240, 320, 3), dtype=np.uint8)
    assert find_marker(empty, CAMERA, near_px=expected) is None
    assert find_marker(view(T, rng, number=8), CAMERA, near_px=expected) is None


@pytest.mark.parametrize("T", [pose(-26.0, 0.0, 0.75), pose(-1.2, -6.0, 0.75, yaw_deg=-79.0)])
def test_too_small_or_too_oblique_a_marker_gives_no_pose(rng, T):
    """198.4 x 0.8 / 26 = 6 px; and a view 11 deg off the marker's plane."""
    assert find_marker(view(T, rng), CAMERA) is None


def test_other_markers_are_named(rng):
    """What was drawn."""
    image = view(pose(-4.0, 0.0, 0.8), rng, number=3, dictionary="DICT_5X5_50")
    assert ("DICT_5X5_50", 3) in name_markers(image)


def test_the_arena_shows_the_marker_where_its_plan_puts_it():
    """The plan: 0.80 m black square, centre at 0.75 m. Its edges are Gaussians, some centimetres
    soft: 2 % of 5 m.
    """
    T = pose(-5.0, 1.0, 1.2, 10.0, -2.0, 10.0)
    frame = render(load_scene("arena"), CAMERA, T)
    seen = find_marker((255.0 * frame.rgb).astype(np.uint8), CAMERA)
    assert seen.T_world_camera[0, :3, 3] == pytest.approx(T[:3, 3], abs=0.1)


def test_a_marker_that_fills_a_large_picture_is_found():
    """3840 x 2160 pixels, the print drawn by OpenCV 1500 wide, its corners on pixel borders; a
    tenth of a pixel.
    """
    camera = PinholeCamera(2400.0, 2400.0, 1920.0, 1080.0, 3840, 2160)
    drawn = cv2.aruco.generateImageMarker(
        cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_4X4_50), 7, 1500
    )
    image = np.full((2160, 3840), 215, np.uint8)
    image[330:1830, 1170:2670] = np.where(drawn > 0, 215, 70)
    by_hand = np.array([(1170.0, 330.0), (2670.0, 330.0), (2670.0, 1830.0), (1170.0, 1830.0)])
    assert find_marker(image, camera).corners_px == pytest.approx(by_hand, abs=0.1)


def waves(x, y):
    """A smooth pattern with edges both ways, grey levels, as a formula."""
    return 120.0 + 50.0 * np.sin(0.4 * x + 0.5 * np.sin(0.2 * y)) + 40.0 * np.cos(0.35 * y)


@pytest.mark.parametrize("along", ["lines", "columns"])
def test_shift_of_each_line_and_column_is_measured(along):
    """The pattern is a formula and can be moved by any fraction of a pixel; contrast and brightness
    differ. Central differences of waves of 0.4 rad a pixel are 1 - sin(0.4) / 0.4 = 3 % too flat:
    0.02 px of the largest shift, twice. Lines shifted sideways do not move columns.
    """
    rng = np.random.default_rng(1)
    y, x = np.mgrid[:30, :40].astype(float)
    shift = rng.normal(0.0, 0.1, 30 if along == "lines" else 40)
    seen = waves(x - shift[:, None], y) if along == "lines" else waves(x, y - shift)
    found = line_and_column_shifts(0.6 * seen + 20.0, waves(x, y), np.ones((30, 40), bool))
    shifted, unshifted = found if along == "lines" else found[::-1]
    assert shifted[1:-1] == pytest.approx(shift[1:-1], abs=0.02)
    assert np.abs(np.nanmean(unshifted)) < 0.03


def test_lines_without_edges_have_no_shift():
    """Upper half striped, lower half blank."""
    y, x = np.mgrid[:20, :40].astype(float)
    drawn = np.where(y < 10, 120.0 + 50.0 * np.sin(0.9 * x), 120.0)
    lines, _ = line_and_column_shifts(drawn, drawn, np.ones((20, 40), bool))
    assert np.isfinite(lines[:10]).all()
    assert np.isnan(lines[10:]).all()


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ({"dictionary": "DICT_9X9"}, "dictionary such as DICT_4X4_50"),
        ({"id": 50}, "id from 0 to 49"),
        ({"size": 0.0}, "marker size"),
    ],
)
def test_a_marker_that_cannot_be_printed_is_refused(arguments, words):
    """One sentence each."""
    with pytest.raises(InputError, match=words):
        Marker(**arguments)


@pytest.mark.parametrize(
    "image",
    [np.zeros((480, 640, 3), np.uint8), np.zeros((240, 320, 3)), np.zeros((0, 0), np.uint8)],
)
def test_an_image_of_another_size_or_kind_is_refused(image):
    """The camera's frames are 320 x 240 bytes."""
    with pytest.raises(InputError, match="image: expected"):
        find_marker(image, CAMERA)
