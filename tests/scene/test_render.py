"""Rendering: every backend matches hand calculations; every wrong argument gets its sentence."""

import math
import sys
from dataclasses import replace

import numpy as np
import pytest

from falconwing_kit.core.checks import InputError
from falconwing_kit.scene import (
    BACKENDS,
    GaussianScene,
    PinholeCamera,
    nose_camera_pose,
    render,
    render_batch,
)

CAMERA = PinholeCamera(50.0, 60.0, 4.5, 3.5, 9, 7)  # pixel (3, 4) looks straight ahead
ON_THIS_MACHINE = ("reference", "fast", "auto")


def ball(rgb=(1.0, 0.5, 0.25)):
    """A ball of 0.1 m, 2 m ahead along world x, 1 m up, of opacity 0.8."""
    sh = (np.array(rgb) - 0.5).reshape(1, 1, 3) * 2.0 * math.sqrt(math.pi)
    return GaussianScene([[2, 0, 1]], [[1, 0, 0, 0]], [[0.1, 0.1, 0.1]], [0.8], sh)


AHEAD = nose_camera_pose((0, 0, 1), 0, 0, 0)


def test_every_backend_is_tried():
    """Those of the design; gsplat needs a GPU and has its own benchmark."""
    assert set(BACKENDS) == {*ON_THIS_MACHINE, "gsplat"}


@pytest.mark.parametrize("backend", ON_THIS_MACHINE)
def test_ball_by_hand(backend):
    """Variances (50 x 0.1 / 2)^2 + 0.3 across and (60 x 0.1 / 2)^2 + 0.3 down; tolerance is an exp
    fitted to 7e-6.
    """
    frame = render(ball(), CAMERA, AHEAD, backend=backend, background=(0.0, 0.0, 1.0))
    v, u = np.mgrid[-3:4, -4:5]
    alpha = 0.8 * np.exp(-u * u / (2 * 6.55) - v * v / (2 * 9.3))
    assert (frame.rgb.shape, frame.alpha.shape, frame.depth.shape) == ((7, 9, 3), (7, 9), (7, 9))
    assert frame.rgb.dtype == frame.alpha.dtype == frame.depth.dtype == np.float32
    assert np.allclose(frame.alpha, alpha, atol=2e-5)
    assert np.allclose(
        frame.rgb, alpha[..., None] * [1, 0.5, 0.25] + (1 - alpha[..., None]) * [0, 0, 1], atol=4e-5
    )
    assert np.allclose(frame.depth, 2.0, rtol=1e-5)


@pytest.mark.parametrize("backend", ON_THIS_MACHINE)
def test_antialiased_reaches_the_backend(backend):
    """By hand: the peak is fainter by the root of the determinants' ratio, 6.25 x 9 before and 6.55
    x 9.3 after.
    """
    frame = render(ball(), CAMERA, AHEAD, backend=backend, antialiased=True)
    assert frame.alpha[3, 4] == pytest.approx(0.8 * math.sqrt(6.25 * 9.0 / (6.55 * 9.3)), abs=2e-5)


@pytest.mark.parametrize("backend", ON_THIS_MACHINE)
def test_colours_are_cut_like_a_camera_s(backend):
    """By hand: 0.8 of a red of 3 is 2.4, which no pixel holds; green 0.8 stays."""
    frame = render(ball(rgb=(3.0, 1.0, 0.0)), CAMERA, AHEAD, backend=backend)
    assert frame.rgb[3, 4].tolist() == pytest.approx([1.0, 0.8, 0.0], abs=2e-5)


@pytest.mark.parametrize("fov_deg", [3.0, 60.0, 120.0, 170.0])
def test_backends_see_one_hall(fov_deg):
    """The fast one equals the reference to 60 dB, the project's bar, amid Gaussians on all sides,
    of degree 3.
    """
    rng = np.random.default_rng(5)
    scene = GaussianScene(
        rng.normal(size=(2000, 3)) * (4, 2, 4),
        rng.normal(size=(2000, 4)),
        np.exp(rng.uniform(np.log(0.02), np.log(0.6), (2000, 3))),
        rng.uniform(0.05, 1.0, 2000),
        rng.normal(size=(2000, 16, 3)) * 0.2,
    )
    camera = PinholeCamera.from_fov_deg(100, 70, fov_deg)
    pose = nose_camera_pose((0.1, 0.2, 0.3), 0.3, -0.1, 0.8)
    exact, quick = (
        render(scene, camera, pose, backend, (0.2, 0.4, 0.6)) for backend in ("reference", "fast")
    )
    assert exact.alpha.mean() > 0.3
    assert np.mean((exact.rgb - quick.rgb) ** 2) < 1e-6
    solid = exact.alpha > 0.5
    assert np.allclose(quick.depth[solid], exact.depth[solid], rtol=1e-3)


@pytest.mark.parametrize("backend", ON_THIS_MACHINE)
def test_a_batch_is_its_poses_one_by_one(backend):
    """Each frame is the one that its pose gives alone, in their order."""
    poses = [nose_camera_pose((x, 0.0, 1.0), 0.1, 0.0, 0.0) for x in (0.0, 0.5, 1.0)]
    frames = render_batch(ball(), CAMERA, poses, backend, (0.0, 0.0, 1.0))
    assert [f.rgb.shape for f in frames] == [(7, 9, 3)] * 3
    for frame, pose in zip(frames, poses, strict=True):
        alone = render(ball(), CAMERA, pose, backend, (0.0, 0.0, 1.0))
        assert np.array_equal(frame.rgb, alone.rgb) and np.array_equal(frame.depth, alone.depth)
    assert not np.array_equal(frames[0].rgb, frames[1].rgb)


@pytest.mark.parametrize(
    ("poses", "sentence"),
    [
        ([], r"Ts_world_camera: expected one pose \(4, 4\) or more in a list, got '\[\]'"),
        (None, "Ts_world_camera: expected one pose .* got 'None'"),
        (AHEAD, r"T_world_camera: expected shape \(4, 4\), got \(4\)"),
        ([AHEAD, np.eye(3)], r"T_world_camera: expected shape \(4, 4\), got \(3, 3\)"),
    ],
)
def test_a_batch_is_of_poses(poses, sentence):
    """No pose, one pose without a list around it, and one of another shape among good ones."""
    with pytest.raises(InputError, match=f"^{sentence}") as caught:
        render_batch(ball(), CAMERA, poses)
    assert "\n" not in str(caught.value)


def changed(row, column, value):
    """The pose with one number replaced."""
    pose = AHEAD.copy()
    pose[row, column] = value
    return pose


@pytest.mark.parametrize(
    ("change", "sentence"),
    [
        ({"scene": "arena"}, "scene: expected a GaussianScene, got str"),
        ({"camera": (50, 60, 4, 3, 9, 7)}, "camera: expected a PinholeCamera, got tuple"),
        (
            {"backend": "opengl"},
            "backend: expected one of auto, fast, reference, gsplat, got 'opengl'",
        ),
        ({"backend": None}, "backend: expected one of .*, got None"),
        ({"backend": ["fast"]}, "backend: expected one of .*, got "),
        ({"T_world_camera": np.eye(3)}, r"T_world_camera: expected shape \(4, 4\), got \(3, 3\)"),
        ({"T_world_camera": "here"}, "T_world_camera: expected an array of numbers"),
        (
            {"T_world_camera": changed(0, 3, math.nan)},
            "T_world_camera: expected finite numbers, got 1 that are not",
        ),
        ({"T_world_camera": AHEAD.T}, "T_world_camera: expected the last row 0 0 0 1"),
        ({"T_world_camera": np.diag([2.0, 2.0, 2.0, 1.0])}, "T_world_camera: expected a rotation"),
        ({"T_world_camera": np.diag([1.0, 1.0, -1.0, 1.0])}, "T_world_camera: expected a rotation"),
        ({"T_world_camera": changed(0, 0, 1e-3)}, "T_world_camera: expected a rotation"),
        ({"background": 0.5}, r"background: expected shape \(3\), got \(\)"),
        ({"background": (0, 0, 255)}, "background: expected red, green and blue in 0..1"),
        ({"background": (0, 0, -0.1)}, "background: expected red, green and blue in 0..1"),
        ({"background": (0, 0, math.nan)}, "background: expected red, green and blue in 0..1"),
        ({"background": "black"}, "background: expected an array of numbers"),
    ],
)
def test_each_wrong_argument_gets_its_sentence(change, sentence):
    """Each is the caller's mistake, refused in one line before anything is drawn."""
    arguments = {"scene": ball(), "camera": CAMERA, "T_world_camera": AHEAD} | change
    with pytest.raises(InputError, match=f"^{sentence}") as caught:
        render(**arguments)
    assert "\n" not in str(caught.value)


def test_pose_of_a_network_is_near_enough():
    """float32 rounds a rotation by 1e-7; a pose that a network put out in float32 must pass."""
    frame = render(ball(), CAMERA, nose_camera_pose((0, 0, 1), 0.3, -0.2, 0.1).astype(np.float32))
    assert np.isfinite(frame.rgb).all()


@pytest.mark.parametrize(
    ("backend", "module", "library"),
    [("reference", "reference", "torch"), ("fast", "fast", "numba"), ("auto", "fast", "numba")],
)
def test_missing_library_is_said_with_its_remedy(monkeypatch, backend, module, library):
    """None in sys.modules makes the import fail as if the library were not installed."""
    monkeypatch.delitem(sys.modules, f"falconwing_kit.scene.{module}", raising=False)
    monkeypatch.setitem(sys.modules, library, None)
    with pytest.raises(InputError, match=f"expected {library} for .*; run: pip install {library}"):
        render(ball(), CAMERA, AHEAD, backend=backend)


@pytest.mark.parametrize("backend", ON_THIS_MACHINE)
def test_several_scenes_are_drawn_as_one(backend):
    """Two balls, one before the other, apart and joined: the definition. Neither hides the other
    whole.
    """
    near, far = (
        ball((0.2, 0.9, 0.1)),
        replace(ball(), means=np.array([[3.0, 0.1, 1.0]], np.float32)),
    )
    apart, joined = (
        render(scenes, CAMERA, AHEAD, backend)
        for scenes in ((far, near), GaussianScene.joined(far, near))
    )
    assert np.array_equal(apart.rgb, joined.rgb)
    assert np.array_equal(apart.depth, joined.depth)
    assert not np.array_equal(apart.rgb, render(near, CAMERA, AHEAD, backend).rgb)
