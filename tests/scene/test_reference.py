"""The reference renderer: gsplat's own images, splats worked out by hand, laws, and gradients by
finite differences.
"""

import json
import math
import struct
from pathlib import Path

import numpy as np
import pytest
import torch
from scipy.special import sph_harm_y

from falconwing_kit.scene import GaussianScene, PinholeCamera
from falconwing_kit.scene import reference as reference_module
from falconwing_kit.scene.reference import (
    GaussianTensors,
    project_gaussians,
    render_reference,
    render_tensors,
    spherical_harmonics,
)

GSPLAT_IMAGES = Path(__file__).resolve().parents[3] / "shared/data/splat/brush_gsplat_cases"
SMALL = PinholeCamera(50.0, 50.0, 4.5, 4.5, 9, 9)  # pixel (4, 4) looks straight ahead
WIDE = PinholeCamera(10.0, 10.0, 20.0, 4.5, 40, 9)  # half of its field has the slope 2
Y0 = 0.5 / math.sqrt(math.pi)


def gaussians(
    means, scales=0.1, opacities=0.8, rgb=(1.0, 0.5, 0.25), quaternions=(1.0, 0.0, 0.0, 0.0)
):
    """Gaussians of one colour each (degree 0) as float64 tensors; one value serves for all."""
    count = len(means)
    sh = (np.broadcast_to(np.array(rgb, float), (count, 3)) - 0.5)[:, None] / Y0
    opacities = np.broadcast_to(opacities, count)
    fields = (
        means,
        np.broadcast_to(quaternions, (count, 4)),
        np.broadcast_to(scales, (count, 3)),
        opacities,
        sh,
    )
    return GaussianTensors(*(torch.tensor(np.array(field, float)) for field in fields))


def draw(scene, camera=SMALL, pose=None, background=(0.0, 0.0, 0.0), antialiased=False):
    """Colour, alpha and depth as float64 arrays."""
    pose = np.eye(4) if pose is None else pose
    images = render_tensors(
        scene, camera, torch.tensor(pose), torch.tensor(background).double(), antialiased
    )
    return tuple(image.numpy() for image in images)


def read_safetensors(path):
    """The arrays of a safetensors file of float32: its length, a JSON table and the numbers."""
    data = path.read_bytes()
    start = 8 + struct.unpack("<Q", data[:8])[0]
    arrays = {}
    for name, entry in json.loads(data[8:start]).items():
        first, last = (start + offset for offset in entry["data_offsets"])
        arrays[name] = (
            np.frombuffer(data[first:last], "<f4").reshape(entry["shape"]).astype(np.float64)
        )
    return arrays


@pytest.mark.parametrize(("dtype", "atol"), [(torch.float32, 1e-4), (torch.float64, 1e-5)])
@pytest.mark.parametrize("case", ["tiny_case", "basic_case"])
def test_images_are_those_of_gsplat(case, dtype, atol):
    """Recorded data: gsplat's CUDA kernels drew them in float32 (brush's test cases, Apache-2.0),
    degree 3.

    SOURCE.txt beside them gives the camera; the file keeps logarithms of scales and logits of
    opacities. The tolerances are the project's; gsplat's own rounding is about 1e-6.
    """
    path = GSPLAT_IMAGES / f"{case}.safetensors"
    if not path.is_file():
        pytest.skip(
            "gsplat's images do not ship with the kit and are not beside this checkout:"
            f" {path} is missing"
        )
    case = read_safetensors(path)
    case |= {
        "scales": np.exp(case["scales"]),
        "opacities": 1.0 / (1.0 + np.exp(-case["opacities"])),
    }
    fields = (case[name] for name in ("means", "quats", "scales", "opacities", "coeffs"))
    pose = torch.eye(4, dtype=dtype)
    pose[:3, 3] = torch.tensor([0.123, 0.456, -8.0])
    rgb, alpha, _ = render_tensors(
        GaussianTensors(*(torch.tensor(field, dtype=dtype) for field in fields)),
        PinholeCamera.from_fov_deg(123, 82, 90.0),
        pose,
        torch.zeros(3, dtype=dtype),
    )
    assert rgb.dtype == dtype and case["out_img"].max() > 0.5
    assert np.abs(rgb.numpy() - case["out_img"][..., :3]).max() < atol
    assert np.abs(alpha.numpy() - case["out_img"][..., 3]).max() < atol


def test_one_round_gaussian_by_hand():
    """A ball of 0.1 m at 2 m through f = 50 px: variance (50 x 0.1 / 2)^2 + 0.3 = 6.55 px^2 in each
    direction.

    Tolerance is float64's rounding; the corner, 4 px off both ways, has 0.8 exp(-32 / 13.1) = 0.07.
    """
    rgb, alpha, depth = draw(gaussians([[0, 0, 2]]))
    v, u = np.mgrid[-4:5, -4:5]
    assert np.allclose(alpha, 0.8 * np.exp(-(u * u + v * v) / (2 * 6.55)), atol=1e-12)
    assert np.allclose(rgb, alpha[..., None] * [1.0, 0.5, 0.25], atol=1e-12)
    assert np.allclose(depth, 2.0, atol=1e-12)


def test_antialiasing_keeps_the_light():
    """By hand: the blur widens 6.25 to 6.55 px^2 both ways: the peak is lower by 6.25 / 6.55."""
    _, alpha, _ = draw(gaussians([[0, 0, 2]]), antialiased=True)
    assert alpha[4, 4] == pytest.approx(0.8 * 6.25 / 6.55, rel=1e-12)
    assert alpha[4, 5] == pytest.approx(0.8 * 6.25 / 6.55 * math.exp(-0.5 / 6.55), rel=1e-12)


def test_needle_lies_along_its_axis():
    """By hand: 0.2 m along x, turned by +45 deg about z, from x to y: right and down. Variances
    25.3 and 6.55 px^2.
    """
    eighth = (math.cos(math.pi / 8), 0, 0, math.sin(math.pi / 8))
    _, alpha, _ = draw(gaussians([[0, 0, 2]], scales=(0.2, 0.1, 0.1), quaternions=eighth))
    assert alpha[6, 6] == pytest.approx(0.8 * math.exp(-8 / 2 / 25.3), rel=1e-12)
    assert alpha[6, 2] == pytest.approx(0.8 * math.exp(-8 / 2 / 6.55), rel=1e-12)


@pytest.mark.parametrize(("x", "slope"), [(1.0, 0.5), (-1.0, 0.5), (8.0, 2.6), (-8.0, 2.6)])
def test_depth_smears_what_is_off_axis(x, slope):
    """By hand: 1 m along z alone, at 2 m, moves u by 10 slope / 2 px; slopes end at 1.3 x 2, far
    outside of the image.

    The last two lie 20 px beside the image and reach into it; a limit of 1.6 would give half as
    much alpha again.
    """
    _, alpha, _ = draw(gaussians([[x, 0, 2]], scales=(1e-6, 1e-6, 1.0)), WIDE)
    u = np.arange(40) + 0.5 - (20.0 + 10.0 * x / 2)
    expected = 0.8 * np.exp(-u * u / 2 / ((10 * slope / 2) ** 2 + 0.3))
    assert np.allclose(alpha[4], np.where(expected >= 1 / 255, expected, 0.0), atol=1e-9)
    assert alpha[4].max() > 0.1


def test_off_centre_camera_cuts_slopes_beyond_its_own_edges():
    """By hand: with cx = 4 of 40 px the right edge has the slope 3.6 and the cut comes 0.6 later,
    at 4.2.
    """
    _, alpha, _ = draw(
        gaussians([[12.0, 0, 2]], scales=(1e-6, 1e-6, 1.0)),
        PinholeCamera(10.0, 10.0, 4.0, 4.5, 40, 9),
    )
    assert alpha[4, 39] == pytest.approx(0.8 * math.exp(-(24.5**2) / 2 / (21.0**2 + 0.3)), rel=1e-6)


def test_nearer_covers_farther_whatever_their_order():
    """By hand: 0.6 of the near one, 0.5 of the 0.4 that is left, 0.2 of the background; depth (1.2
    + 0.8) / 0.8.
    """
    scene = gaussians([[0, 0, 4], [0, 0, 2]], opacities=(0.5, 0.6), rgb=[(1, 0, 0), (0, 1, 0)])
    rgb, alpha, depth = draw(scene, background=(0.0, 0.0, 1.0))
    assert np.allclose(rgb[4, 4], [0.2, 0.6, 0.2], atol=1e-12)
    assert alpha[4, 4] == pytest.approx(0.8, rel=1e-12)
    assert depth[4, 4] == pytest.approx(2.5, rel=1e-12)


def test_full_pixel_takes_no_more():
    """By hand: alpha is at most 0.999; the second would leave 0.001 x 0.05 <= 1e-4: it is not
    composited, nor the third.
    """
    scene = gaussians(
        [[0, 0, 2], [0, 0, 3], [0, 0, 4]],
        opacities=(1.0, 0.95, 0.1),
        rgb=[(1, 0, 0), (0, 1, 0), (0, 1, 0)],
    )
    rgb, alpha, depth = draw(scene, background=(0.0, 0.0, 1.0))
    assert np.allclose(rgb[4, 4], [0.999, 0.0, 0.001], atol=1e-12)
    assert (alpha[4, 4], depth[4, 4]) == (
        pytest.approx(0.999, rel=1e-12),
        pytest.approx(2.0, rel=1e-12),
    )


def test_what_is_fainter_than_a_level_is_left_out():
    """By hand: 1/255 = 0.00392; below it nothing is drawn, just above it only the middle, next to
    it 0.004 x 0.926.
    """
    assert draw(gaussians([[0, 0, 2]], opacities=0.0039))[1].max() == 0.0
    _, alpha, _ = draw(gaussians([[0, 0, 2]], opacities=0.004))
    assert alpha[4, 4] == pytest.approx(0.004, rel=1e-12) and np.count_nonzero(alpha) == 1


@pytest.mark.parametrize(
    "mean", [(0, 0, -2), (0, 0, 0), (0, 0, 0.009), (0.5, 0, 0.009), (3, 0, 2), (0, -3, 2)]
)
def test_behind_too_near_or_beside_gives_the_background(mean):
    """By the convention nothing nearer than 0.01 m is drawn; the last two lie far outside of the
    image.
    """
    rgb, alpha, depth = draw(gaussians([mean]), background=(0.1, 0.2, 0.3))
    assert np.allclose(rgb, [0.1, 0.2, 0.3], atol=1e-12)
    assert alpha.max() == depth.max() == 0.0


def hall(dtype=torch.float64, count=300, degree=3, seed=4):
    """Gaussians on all sides of a camera at the origin, some as near as a centimetre, needles and
    discs among them.
    """
    rng = np.random.default_rng(seed)
    fields = (
        rng.normal(size=(count, 3)) * (2.0, 1.0, 2.0),
        rng.normal(size=(count, 4)),
        np.exp(rng.uniform(np.log(0.005), np.log(0.5), (count, 3))),
        rng.uniform(0.05, 1.0, count),
        rng.normal(size=(count, (degree + 1) ** 2, 3)) * 0.3,
    )
    return GaussianTensors(*(torch.tensor(field, dtype=dtype) for field in fields))


def test_camera_in_the_crowd_sees_a_sane_image():
    """A law: whatever stands beside, behind or at the lens, weights are shares: alpha in 0..1,
    depth in the hall.
    """
    rgb, alpha, depth = draw(hall(), PinholeCamera.from_fov_deg(50, 30, 130.0))
    assert all(np.isfinite(image).all() for image in (rgb, alpha, depth))
    assert alpha.min() >= 0.0 and 0.5 < alpha.max() <= 1.0
    assert depth.max() < 8.0 and rgb.max() < 5.0


def test_image_does_not_depend_on_tiles(monkeypatch):
    """A law: tiles and chunks only divide the work. Tolerance is the rounding of sums in another
    order.
    """
    camera = PinholeCamera.from_fov_deg(37, 21, 110.0)
    before = draw(hall(), camera)
    monkeypatch.setattr(reference_module, "TILE_PX", 64)
    monkeypatch.setattr(reference_module, "CHUNK", 7)
    for image, expected in zip(draw(hall(), camera), before, strict=True):
        assert np.allclose(image, expected, atol=1e-10)


def test_float32_is_float64_but_for_rounding():
    """float32 has 1e-7; a hundred splats over a pixel and needles' determinants lose two or three
    digits of it.
    """
    camera = PinholeCamera.from_fov_deg(50, 30, 90.0)
    scene = hall(torch.float32)
    coarse = render_tensors(scene, camera, torch.eye(4), torch.zeros(3))
    fine = draw(GaussianTensors(*(tensor.double() for tensor in scene)), camera)
    assert coarse[0].dtype == torch.float32
    assert np.abs(coarse[0].numpy() - fine[0]).max() < 1e-4


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_harmonics_are_scipy_s(degree):
    """SciPy's complex harmonics carry Condon and Shortley's phase; the real ones are sqrt(2) Re or
    Im of order |m|.
    """
    directions = np.random.default_rng(degree).normal(size=(40, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    x, y, z = directions.T
    polar, azimuth = np.arccos(z), np.arctan2(y, x)
    expected = []
    for order in range(-degree, degree + 1):
        value = sph_harm_y(degree, abs(order), polar, azimuth)
        expected.append(
            math.sqrt(2) * (value.imag if order < 0 else value.real) if order else value.real
        )
    got = spherical_harmonics(torch.tensor(directions), (degree + 1) ** 2).numpy()
    assert np.allclose(got[:, degree**2 :], np.stack(expected, axis=1), atol=1e-12)


def pose_of(rotation_vector, place):
    """A pose from an axis times an angle [rad] and a place [m], by SciPy."""
    from scipy.spatial.transform import Rotation

    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = Rotation.from_rotvec(rotation_vector).as_matrix(), place
    return pose


def test_colour_goes_with_the_direction_in_the_world():
    """By hand: a camera at y = -2 looks along world y at the origin; Y_1 is 0.4886 (-y, z, -x), so
    y alone counts.
    """
    looks_along_y = pose_of([-math.pi / 2, 0, 0], [0, -2, 0])
    scene = gaussians([[0, 0, 0]], rgb=(0.5, 0.5, 0.5))
    sh = torch.zeros(1, 4, 3, dtype=torch.float64)
    sh[0, 1, 0], sh[0, 2, 1], sh[0, 3, 2] = -0.2, 0.7, 0.7
    rgb, alpha, _ = draw(scene._replace(sh=sh), pose=looks_along_y)
    assert np.allclose(
        rgb[4, 4] / alpha[4, 4], [0.5 + 0.2 * math.sqrt(0.75 / math.pi), 0.5, 0.5], atol=1e-12
    )


def test_colour_is_never_negative():
    """By hand: 1/2 + 0.2821 x (-5) is cut to 0."""
    scene = gaussians([[0, 0, 2]])
    assert draw(scene._replace(sh=torch.full((1, 1, 3), -5.0).double()))[0].max() == 0.0


@pytest.mark.parametrize("antialiased", [False, True])
def test_turning_the_world_with_the_camera_changes_nothing(antialiased):
    """A law, for colours of degree 0; SciPy multiplies quaternions. Tolerance is rounding."""
    from scipy.spatial.transform import Rotation

    turn, scene = Rotation.from_rotvec([0.4, -1.1, 0.7]), hall(degree=0)
    camera, pose = (
        PinholeCamera.from_fov_deg(40, 30, 100.0),
        pose_of([0.2, 0.1, -0.3], [0.1, 0.2, 0.0]),
    )
    moved = pose_of(turn.as_rotvec(), [1.0, -2.0, 3.0])
    quaternions = turn * Rotation.from_quat(scene.quaternions.numpy(), scalar_first=True)
    turned = scene._replace(
        means=torch.tensor(scene.means.numpy() @ moved[:3, :3].T + moved[:3, 3]),
        quaternions=torch.tensor(quaternions.as_quat(scalar_first=True)),
    )
    black = (0.0, 0.0, 0.0)
    before, after = (
        draw(scene, camera, pose, black, antialiased),
        draw(turned, camera, moved @ pose, black, antialiased),
    )
    for image, expected in zip(after, before, strict=True):
        assert np.allclose(image, expected, atol=1e-8)


def small_scene():
    """Three overlapping Gaussians of degree 3; one stands so far beside the image that its slope is
    cut.
    """
    rng = np.random.default_rng(8)
    fields = (
        [[0.05, 0.02, 2.0], [-0.1, 0.1, 2.6], [1.2, 0.1, 2.2]],
        rng.normal(size=(3, 4)),
        [[0.4, 0.2, 0.3], [0.4, 0.6, 0.2], [0.6, 0.8, 0.7]],
        [0.7, 0.6, 0.8],
        rng.normal(size=(3, 16, 3)) * 0.1,
    )
    return GaussianTensors(*(torch.tensor(np.array(field), requires_grad=True) for field in fields))


@pytest.mark.parametrize(
    ("antialiased", "remembered", "chunk"),
    [(False, 50_000, 256), (True, 50_000, 256), (True, 0, 2)],
)
def test_gradients_are_those_of_finite_differences(monkeypatch, antialiased, remembered, chunk):
    """torch's gradcheck moves every number of scene, pose and background by 1e-6 both ways; float64
    leaves 1e-9.

    With nothing saved, tiles are recomputed in the backward pass, and small chunks follow each
    other in a tile, as in large scenes.
    """
    monkeypatch.setattr(reference_module, "MAX_SAVED_SPLATS", remembered)
    monkeypatch.setattr(reference_module, "CHUNK", chunk)
    camera = PinholeCamera(12.0, 12.0, 3.1, 2.4, 6, 5)
    pose = torch.tensor(pose_of([0.05, -0.04, 0.3], [0.02, 0.03, -0.1]), requires_grad=True)
    background = torch.tensor([0.1, 0.4, 0.7], dtype=torch.float64, requires_grad=True)
    inputs = (*small_scene(), pose, background)

    def images(*tensors):
        return render_tensors(GaussianTensors(*tensors[:5]), camera, *tensors[5:], antialiased)

    assert (
        len(project_gaussians(GaussianTensors(*inputs[:5]), camera, pose, antialiased).depths) == 3
    )
    assert torch.autograd.gradcheck(images, inputs, eps=1e-6, atol=1e-7, rtol=1e-5)


def test_empty_view_has_gradients_of_zero():
    """Training meets views without a Gaussian; the backward pass must not fail there."""
    scene = GaussianTensors(*(tensor.requires_grad_() for tensor in gaussians([[0, 0, -2]])))
    rgb, _, _ = render_tensors(
        scene, SMALL, torch.eye(4, dtype=torch.float64), torch.zeros(3, dtype=torch.float64)
    )
    rgb.sum().backward()
    assert all(tensor.grad is not None and tensor.grad.abs().max() == 0.0 for tensor in scene)


def test_gradients_in_the_crowd_are_finite():
    """A law: needles, Gaussians at the lens and one too small for float32's squares have slopes
    too.
    """
    scene = hall(torch.float32)
    scene.means[0], scene.scales[0] = torch.tensor([0.0, 0.0, 1.0]), 1e-30
    scene = GaussianTensors(*(tensor.requires_grad_() for tensor in scene))
    pose = torch.eye(4, requires_grad=True)
    rgb, alpha, depth = render_tensors(
        scene, PinholeCamera.from_fov_deg(50, 30, 130.0), pose, torch.zeros(3), True
    )
    (rgb.sum() + alpha.sum() + depth.sum()).backward()
    assert all(bool(tensor.grad.isfinite().all()) for tensor in (*scene, pose))


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_a_scene_is_rendered_as_its_tensors_are(dtype):
    """The same equations by the other function; the output is float32 for either dtype."""
    tensors = hall(torch.float32)
    scene = GaussianScene(*(tensor.numpy() for tensor in tensors))
    camera, pose = PinholeCamera.from_fov_deg(20, 10, 90.0), pose_of([0.1, 0.2, 0.3], [0, 0, 0.5])
    got = render_reference(scene, camera, pose, (0.2, 0.4, 0.6), antialiased=True, dtype=dtype)
    expected = render_tensors(
        GaussianTensors(*(tensor.to(dtype) for tensor in tensors)),
        camera,
        torch.tensor(pose, dtype=dtype),
        torch.tensor([0.2, 0.4, 0.6], dtype=dtype),
        antialiased=True,
    )
    for image, tensor in zip(got, expected, strict=True):
        assert image.dtype == np.float32
        assert np.allclose(
            image, tensor.numpy(), atol=1e-4
        )  # quaternions are brought to length 1 in float32
