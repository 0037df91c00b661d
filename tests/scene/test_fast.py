"""The fast renderer beside a plain float64 one that shares no line with it, and beside images of
gsplat's kernels.
"""

import json
import math
import os
import re
import struct
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
import pytest
from numba import njit
from scipy.spatial.transform import Rotation
from scipy.special import sph_harm_y

from falconwing_kit.core.checks import InputError
from falconwing_kit.scene import GaussianScene, PinholeCamera, fast, nose_camera_pose
from falconwing_kit.scene.fast import render_fast

ROOT = Path(__file__).resolve().parents[2]
KIT = ROOT / "falconwing_kit"
GSPLAT_IMAGES = ROOT.parent / "shared/data/splat/brush_gsplat_cases"
BLACK = (0.0, 0.0, 0.0)
AHEAD = nose_camera_pose((0.0, 0.0, 1.5), 0.0, 0.0, 0.0)
ROLLED = nose_camera_pose((-15.0, 4.0, 1.2), 0.3, -0.1, 0.5)
SMALL = PinholeCamera.from_fov_deg(48, 36, 80.0)


def plain_image(scene, camera, T_world_camera, background=BLACK, antialiased=False):
    """gsplat's "classic" equations, one Gaussian after the other over the whole image, in float64.

    The order is that of the depths in float32, as in gsplat; the harmonics are SciPy's complex
    ones.
    """
    R_world_camera, u_v = (
        T_world_camera[:3, :3],
        np.stack(np.meshgrid(*map(np.arange, (camera.width, camera.height)))),
    )
    p_camera = (scene.means.astype(float) - T_world_camera[:3, 3]) @ R_world_camera
    colours = plain_colours(scene, T_world_camera[:3, 3])
    passing, rgb, depth = (
        np.ones(u_v.shape[1:]),
        np.zeros((*u_v.shape[1:], 3)),
        np.zeros(u_v.shape[1:]),
    )
    full = np.zeros(passing.shape, bool)
    for i in np.argsort(p_camera[:, 2].astype(np.float32), kind="stable"):
        x, y, z = p_camera[i]
        if z < 0.01:
            continue
        cov = plain_cov(scene, i, camera, R_world_camera, x, y, z)
        blurred = cov + 0.3 * np.eye(2)
        fade = (
            math.sqrt(max(0.0, np.linalg.det(cov) / np.linalg.det(blurred))) if antialiased else 1.0
        )
        d = (
            u_v
            + 0.5
            - np.array([camera.fx * x / z + camera.cx, camera.fy * y / z + camera.cy])[
                :, None, None
            ]
        )
        sigma = 0.5 * np.einsum("ihw,ij,jhw->hw", d, np.linalg.inv(blurred), d)
        alpha = np.minimum(0.999, float(scene.opacities[i]) * fade * np.exp(-sigma))
        alpha[alpha < 1.0 / 255.0] = 0.0
        full |= (passing * (1.0 - alpha) <= 1e-4) & (alpha > 0.0)
        share = np.where(full, 0.0, alpha * passing)
        rgb, depth, passing = (
            rgb + share[..., None] * colours[i],
            depth + share * z,
            passing - share,
        )
    return (
        rgb + passing[..., None] * np.array(background),
        1.0 - passing,
        depth / np.maximum(1.0 - passing, 1e-10),
    )


def plain_cov(scene, i, camera, R_world_camera, x, y, z):
    """(2, 2) covariance in the image, linearised where the centre is, but within 1.3 half fields of
    view.
    """
    R_world_cloud = Rotation.from_quat(scene.quaternions[i].astype(float)[[1, 2, 3, 0]]).as_matrix()
    A = R_world_camera.T @ R_world_cloud @ np.diag(scene.scales[i].astype(float))
    half_u, half_v = 0.5 * camera.width / camera.fx, 0.5 * camera.height / camera.fy
    x = z * np.clip(
        x / z,
        -camera.cx / camera.fx - 0.3 * half_u,
        (camera.width - camera.cx) / camera.fx + 0.3 * half_u,
    )
    y = z * np.clip(
        y / z,
        -camera.cy / camera.fy - 0.3 * half_v,
        (camera.height - camera.cy) / camera.fy + 0.3 * half_v,
    )
    J = np.array(
        [[camera.fx / z, 0.0, -camera.fx * x / z**2], [0.0, camera.fy / z, -camera.fy * y / z**2]]
    )
    return J @ A @ (J @ A).T


def plain_colours(scene, p_world):
    """(N, 3): real harmonics from SciPy's complex ones, whose sign (-1)^m is that of the splats'
    files.
    """
    x, y, z = (scene.means - p_world).T.astype(float)
    polar, azimuth = np.arctan2(np.hypot(x, y), z), np.arctan2(y, x)
    rgb = np.full((len(scene), 3), 0.5)
    for k in range(scene.sh.shape[1]):
        degree = math.isqrt(k)
        order = k - degree**2 - degree
        Y = sph_harm_y(degree, abs(order), polar, azimuth)
        real = Y.real if order == 0 else math.sqrt(2.0) * (Y.real if order > 0 else Y.imag)
        rgb += real[:, None] * scene.sh[:, k]
    return np.maximum(rgb, 0.0)


def random_scene(seed, count=60, basis=4, low=(2.0, -4.0, -2.0), high=(12.0, 4.0, 4.0)):
    """Gaussians of all shapes and opacities in a box, which may extend behind the camera."""
    rng = np.random.default_rng(seed)
    return GaussianScene(
        rng.uniform(low, high, (count, 3)),
        rng.normal(size=(count, 4)),
        10.0 ** rng.uniform(-2.5, 0.3, (count, 3)),
        rng.uniform(0.0, 1.0, count),
        rng.normal(size=(count, basis, 3)) * 0.3,
    )


def hall(basis, count=1500, seed=0):
    """A hall 40 x 20 x 5 m of flat, overlapping clouds on its six sides, all around the camera."""
    rng = np.random.default_rng(seed)
    half = np.array([20.0, 10.0, 2.5])
    axis = rng.integers(0, 3, count)
    means = rng.uniform(-half, half, (count, 3))
    means[np.arange(count), axis] = (half * rng.choice([-1.0, 1.0], (count, 1)))[
        np.arange(count), axis
    ]
    scales = rng.uniform(0.2, 0.9, (count, 3))
    scales[np.arange(count), axis] = 0.01
    sh = rng.normal(size=(count, basis, 3)) * 0.3
    return GaussianScene(
        means + np.array([0.0, 0.0, 2.5]),
        np.tile([1, 0, 0, 0], (count, 1)),
        scales,
        rng.uniform(0.5, 1, count),
        sh,
    )


def require_close(got, want, share_over=0.001):
    """60 dB, one pixel in a thousand over 2/255, depth within 1e-3 where alpha > 0.5: the
    renderer's targets.

    A pixel where a splat is just above 1/255 in one and just below in the other differs by 1/255.
    """
    (rgb, alpha, depth), (rgb_want, alpha_want, depth_want) = got, want
    assert rgb.dtype == alpha.dtype == depth.dtype == np.float32
    assert np.abs(alpha - alpha_want).max() < 0.01
    assert np.mean((rgb - rgb_want) ** 2) < 1e-6
    assert np.mean(np.abs(rgb - rgb_want).max(axis=-1) > 2.0 / 255.0) <= share_over
    seen = alpha_want > 0.5
    assert np.abs(depth[seen] / depth_want[seen] - 1.0).max(initial=0.0) < 1e-3


@pytest.mark.parametrize("fov_deg", [4.0, 90.0, 160.0])
@pytest.mark.parametrize("basis", [1, 4, 9, 16])
def test_hall_from_inside_is_that_of_the_plain_equations(basis, fov_deg):
    """Plain float64 equations; a very long and a very wide lens, Gaussians beside and behind the
    camera.
    """
    camera = PinholeCamera.from_fov_deg(80, 60, fov_deg)
    scene = hall(basis)
    require_close(render_fast(scene, camera, ROLLED), plain_image(scene, camera, ROLLED))


def test_hall_is_that_of_the_reference():
    """The torch renderer in float64: the two must agree as both agree with gsplat."""
    import torch

    from falconwing_kit.scene.reference import render_reference

    camera, scene = PinholeCamera.from_fov_deg(160, 120, 120.0), hall(9)
    require_close(
        render_fast(scene, camera, ROLLED),
        render_reference(scene, camera, ROLLED, BLACK, dtype=torch.float64),
    )


@pytest.mark.parametrize("case", ["tiny_case", "basic_case"])
def test_images_are_those_of_gsplat(case):
    """Recorded data: gsplat's CUDA kernels drew them (brush's test cases, Apache-2.0); SOURCE.txt
    gives the camera.

    gsplat's own rounding is about 1e-6; ours adds about as much for each of up to sixteen clouds on
    a pixel.
    """
    path = GSPLAT_IMAGES / f"{case}.safetensors"
    if not path.is_file():
        pytest.skip(
            "gsplat's images do not ship with the kit and are not beside this checkout:"
            f" {path} is missing"
        )
    data = path.read_bytes()
    start = 8 + struct.unpack("<Q", data[:8])[0]
    file = {
        name: np.frombuffer(
            data[start:], "<f4", math.prod(e["shape"]), e["data_offsets"][0]
        ).reshape(e["shape"])
        for name, e in json.loads(data[8:start]).items()
    }
    opacities = 1.0 / (1.0 + np.exp(-file["opacities"].astype(float)))
    scene = GaussianScene(
        file["means"], file["quats"], np.exp(file["scales"]), opacities, file["coeffs"]
    )
    pose = np.eye(4)
    pose[:3, 3] = (0.123, 0.456, -8.0)
    rgb, alpha, _ = render_fast(scene, PinholeCamera.from_fov_deg(123, 82, 90.0), pose)
    assert np.abs(rgb - file["out_img"][..., :3]).max() < 1e-5
    assert np.abs(alpha - file["out_img"][..., 3]).max() < 1e-5


@pytest.mark.parametrize("seed", range(40))
def test_random_scenes_are_those_of_the_plain_equations(seed):
    """Plain float64 equations, on a box around and behind the camera, antialiased or not, over a
    coloured background.

    One of 1728 pixels may lie over 2/255: three splats at the edge of 1/255 in it.
    """
    rng = np.random.default_rng(1000 + seed)
    low = (-6.0, -4.0, -2.0) if seed % 2 else (1.0, -4.0, -2.0)
    scene, background = (
        random_scene(seed, basis=int(rng.choice([1, 4, 9, 16])), low=low),
        rng.uniform(0.0, 1.0, 3),
    )
    camera = PinholeCamera(*rng.uniform(10, 90, 2), *rng.uniform((-5, -5), (53, 41)), 48, 36)
    pose = nose_camera_pose((0.0, 0.0, 1.0), *rng.uniform(-0.6, 0.6, 3))
    antialiased = bool(seed % 3)
    got = render_fast(scene, camera, pose, background, antialiased)
    require_close(got, plain_image(scene, camera, pose, background, antialiased))


@pytest.mark.parametrize("size", [(1, 1), (17, 3), (3, 17), (16, 16), (33, 1)])
def test_sizes_that_no_tile_divides(size):
    """Plain float64 equations on images smaller than a tile or a little larger."""
    camera = PinholeCamera.from_fov_deg(*size, 60.0)
    got, want = (
        draw(random_scene(7), camera, AHEAD, (0.2, 0.4, 0.6)) for draw in (render_fast, plain_image)
    )
    assert got[0].shape == (size[1], size[0], 3)
    require_close(got, want, share_over=0.0)


def test_nothing_in_front_leaves_the_background():
    """By hand: all Gaussians lie behind, so that every pixel is the background to the last bit."""
    behind = random_scene(3, low=(-9.0, -4.0, -2.0), high=(-1.0, 4.0, 4.0))
    rgb, alpha, depth = render_fast(behind, SMALL, AHEAD, (0.25, 0.5, 1.0))
    assert np.array_equal(rgb, np.broadcast_to(np.float32([0.25, 0.5, 1.0]), rgb.shape))
    assert not alpha.any()
    assert not depth.any()


def test_camera_inside_a_gaussian():
    """Plain float64 equations: a cloud of 2 m around a point 0.3 m ahead, others behind it and one
    on the camera.
    """
    means = [[0.3, 0.1, 1.5], [4.0, 0.0, 1.5], [0.0, 0.0, 1.5]]
    scene = GaussianScene(
        means,
        [[1, 0, 0, 0]] * 3,
        [[2.0] * 3, [0.5] * 3, [1.0] * 3],
        [0.7, 0.9, 0.9],
        np.ones((3, 1, 3)),
    )
    require_close(render_fast(scene, SMALL, AHEAD), plain_image(scene, SMALL, AHEAD))


def test_a_point_is_as_wide_as_the_blur():
    """By hand: scales of 1e-30 m leave the variance 0.3 px^2, so 1 px off the centre alpha is 0.9
    exp(-1 / 0.6).
    """
    scene = GaussianScene(
        [[5.0, 0, 1.5]], [[1, 0, 0, 0]], [[1e-30] * 3], [0.9], np.zeros((1, 1, 3))
    )
    _, alpha, depth = render_fast(scene, PinholeCamera(50.0, 50.0, 4.5, 4.5, 9, 9), AHEAD)
    e = math.exp(-1.0 / 0.6)
    assert alpha[3:6, 3:6] == pytest.approx(
        0.9 * np.array([[e * e, e, e * e], [e, 1, e], [e * e, e, e * e]]), abs=3e-5
    )
    assert depth[4, 4] == pytest.approx(5.0, rel=1e-6)
    assert (
        np.count_nonzero(alpha) == 9
    )  # exp(-r^2 / 0.6) > 1 / (255 * 0.9) for r^2 < 3.26: r^2 = 0, 1 or 2


@pytest.mark.parametrize("scale", [1e-30, 1e6, 1e15, 1e30, 3e38])
def test_extreme_scales_stay_finite(scale):
    """By hand: a cloud far wider than the view has one alpha everywhere, its opacity; a needle is
    no worse.
    """
    scales = [[scale] * 3, [scale, 1e-30, 1e-30], [1e-30, scale, scale]]
    means = [[5.0, 0.0, 1.5], [3.0, 1.0, 1.0], [4e20, 1e20, 1e20]]
    scene = GaussianScene(
        means,
        [[1, 0, 0, 0], [1, 1, 0, 0], [1, 2, 3, 4]],
        scales,
        [0.5, 0.5, 0.5],
        np.ones((3, 1, 3)),
    )
    for one in (scene, scene.selected(np.array([True, False, False]))):
        for image in render_fast(one, SMALL, AHEAD):
            assert np.isfinite(image).all()
    if scale > 1.0:
        assert render_fast(one, SMALL, AHEAD)[1] == pytest.approx(0.5, abs=1e-4)


def test_equal_depths_keep_the_order_of_the_scene():
    """By hand: of two clouds at one depth the first covers: 0.6 of it, 0.6 of the remaining 0.4 of
    the other.
    """
    sh = (np.array([[[1.0, 0.0, 0.0]], [[0.0, 1.0, 0.0]]]) - 0.5) / 0.28209479177387814
    scene = GaussianScene([[5.0, 0, 1.5]] * 2, [[1, 0, 0, 0]] * 2, [[1.0] * 3] * 2, [0.6, 0.6], sh)
    rgb, _, _ = render_fast(scene, PinholeCamera(50.0, 50.0, 4.5, 4.5, 9, 9), AHEAD)
    assert rgb[4, 4] == pytest.approx([0.6, 0.24, 0.0], abs=5e-5)


def test_an_opaque_cloud_lets_a_thousandth_pass_and_nothing_after_it():
    """By hand: of opacity 1 at most 0.999 counts; a second such cloud would leave 1e-6 < 1e-4, so
    it is not drawn.
    """
    sh = (np.array([[[1.0, 0.0, 0.0]], [[0.0, 1.0, 0.0]]]) - 0.5) / 0.28209479177387814
    scene = GaussianScene(
        [[5.0, 0, 1.5], [6.0, 0, 1.5]], [[1, 0, 0, 0]] * 2, [[1.0] * 3] * 2, [1.0, 1.0], sh
    )
    rgb, alpha, depth = render_fast(
        scene, PinholeCamera(50.0, 50.0, 4.5, 4.5, 9, 9), AHEAD, (0.0, 0.0, 1.0)
    )
    assert rgb[4, 4] == pytest.approx([0.999, 0.0, 0.001], abs=1e-6)
    assert alpha[4, 4] == pytest.approx(0.999, abs=1e-6)
    assert depth[4, 4] == pytest.approx(5.0, rel=1e-5)


def test_several_scenes_are_drawn_as_one():
    """The joined scene, whose colours of a lower degree are filled with zeros: the same to the last
    bit.
    """
    parts = hall(1, count=300), random_scene(5, basis=9)
    require_same(
        render_fast(parts, SMALL, AHEAD), render_fast(GaussianScene.joined(*parts), SMALL, AHEAD)
    )


def test_nearest_first_is_a_stable_sort():
    """NumPy's stable sort, on depths of which many are equal and some are out of view."""
    depths = np.random.default_rng(0).choice(
        np.float32([0.01, 0.5, 0.50000006, 3.0, 1e9, 3e38, np.inf]), 3000
    )
    depths[::7] = np.random.default_rng(1).uniform(0.01, 99.0, len(depths[::7]))
    in_view = np.flatnonzero(np.isfinite(depths)).astype(np.uint32)
    want = in_view[np.argsort(depths[in_view], kind="stable")]
    assert fast.sort_by_depth(in_view, depths.view(np.uint32)).tolist() == want.tolist()


def test_threads_and_bands_change_no_bit(monkeypatch):
    """A tile's list and its pixels do not depend on who works on them, nor on how many tiles are
    made at once.
    """
    scene, camera = hall(4), PinholeCamera.from_fov_deg(150, 70, 100.0)
    first = render_fast(scene, camera, ROLLED, threads=1)
    for threads in (1, 2, 5, None):
        require_same(render_fast(scene, camera, ROLLED, threads=threads), first)
    for most in (20_000, 5_000, 1):
        monkeypatch.setattr(fast, "MAX_INTERSECTIONS", most)
        assert len(list(fast._bands(np.full(2000, 50, np.int32), 150, 70))) > 1
        require_same(render_fast(scene, camera, ROLLED, threads=2), first)


def test_two_callers_at_once_get_their_own_images():
    """The images drawn one after the other; nothing is shared between calls."""
    scenes = [random_scene(seed) for seed in range(8)]
    alone = [render_fast(scene, SMALL, AHEAD, threads=1) for scene in scenes]
    with ThreadPoolExecutor(4) as pool:
        for got, want in zip(
            pool.map(lambda scene: render_fast(scene, SMALL, AHEAD, threads=2), scenes),
            alone,
            strict=True,
        ):
            require_same(got, want)


def require_same(got, want):
    """Equal to the last bit."""
    for one, other in zip(got, want, strict=True):
        assert np.array_equal(one, other)


def test_polynomial_is_the_exponential():
    """NumPy's exp over the whole ellipse. By hand: six Chebyshev points on 0..h = ln(255) / 8 leave
    2 (h / 4)^6 / 6! = 8e-8 of each of eight factors, e^-h at least; their rounding is as large:
    3e-6 in all at most.
    """
    s = np.linspace(0.0, math.log(255.0), 1001).astype(np.float32)
    p = fast.P0 + s * (fast.P1 + s * (fast.P2 + s * (fast.P3 + s * (fast.P4 + s * fast.P5))))
    assert p**8 == pytest.approx(np.exp(-s.astype(float)), rel=3e-6)


def test_blending_works_on_several_pixels_at_once():
    """The compiler's own listing: packed products, one for each of fifteen, or the loop lost its
    vectors.
    """
    add_splat = njit(nogil=True, error_model="numpy", fastmath={"contract", "nsz"})(
        fast.blend_splat.py_func
    )
    add_splat(np.zeros(1, fast.SPLAT)[0], 0, 3, 0, 0, np.ones(5 * fast.TILE_PIXELS, np.float32))
    listing = "".join(add_splat.inspect_asm().values())
    assert (
        len(re.findall(r"\b(?:v?mulps|vfn?m\w+ps|fml\w+\s+v\d+\.4s|fmul\s+v\d+\.4s)\b", listing))
        >= 15
    )


def test_projection_works_on_several_gaussians_at_once():
    """The compiler's own listing: packed square roots, one for each of four, or the loop lost its
    vectors.
    """
    project = njit(nogil=True, error_model="numpy", fastmath={"contract", "nsz"})(
        fast.project_block.py_func
    )
    block = np.ones(fast.BLOCK_COLUMNS * fast.BLOCK)
    project(fast.BLOCK, np.eye(3), (50.0, 50.0, 30.0, 20.0, 60, 40), block)
    listing = "".join(project.inspect_asm().values())
    assert len(re.findall(r"\b(?:v?sqrtpd|fsqrt\s+v\d+\.2d)\b", listing)) >= 4


def test_a_depth_that_no_float32_holds_is_not_drawn():
    """Seen from x = -3e38 m a Gaussian at 3e38 m is 6e38 m away, more than a float32 holds: there
    is nothing of it, and its neighbour at 5 m is drawn as alone.
    """
    scene = GaussianScene(
        [[3e38, 0.0, 1.5], [5.0, 0.0, 1.5]],
        [[1, 0, 0, 0]] * 2,
        [[0.2] * 3] * 2,
        [0.9] * 2,
        np.zeros((2, 1, 3)),
    )
    pose = AHEAD.copy()
    pose[0, 3] = -3e38
    near = render_fast(scene.selected(np.array([False, True])), SMALL, pose)
    assert near[1].any()
    require_same(render_fast(scene, SMALL, pose), near)


@pytest.mark.parametrize("margin", [0.9, 1.1])
def test_an_ellipse_that_ends_at_the_edge(margin):
    """By hand: a ball of 10 px whose centre is 0.9 of its reach, sqrt(2 ln 255) sigma, left of the
    image shows in its first column; at 1.1 of it nothing does. So on all four sides.
    """
    camera = PinholeCamera(100.0, 100.0, 30.0, 20.0, 60, 40)
    sigma = math.sqrt(10.0**2 + 0.3)
    reach = margin * math.sqrt(2.0 * math.log(255.0)) * sigma
    for u, v in ((-reach, 20.0), (60.0 + reach, 20.0), (30.0, -reach), (30.0, 40.0 + reach)):
        # the covariance grows off the axis, as (1 + (x/z)^2): the ball shrinks by it
        x, y = (u - 30.0) / 100.0, (v - 20.0) / 100.0
        wide = math.sqrt(1.0 + clamp_to_margin(x, 0.3) ** 2 + clamp_to_margin(y, 0.2) ** 2)
        scene = GaussianScene(
            [[x * 10.0, y * 10.0, 10.0]], [[1, 0, 0, 0]], [[1.0 / wide] * 3], [1.0],
            np.zeros((1, 1, 3)),
        )  # fmt: skip
        alpha = render_fast(scene, camera, np.eye(4))[1]
        assert alpha.any() == (margin < 1.0)


def clamp_to_margin(ratio, half):
    """The ratio x/z within 1.3 half fields of view, up to which the projection is linearised."""
    return min(max(ratio, -1.3 * half), 1.3 * half)


@pytest.mark.skipif(
    sys.platform == "win32", reason="the folders are made unusable in the way of Unix"
)
def test_works_where_no_cache_can_be_written(tmp_path):
    """A fresh Python with the package where compiled code cannot be kept: neither beside the file
    nor at home.
    """
    package = tmp_path / "falconwing_kit"
    for name in ("__init__.py", *(str(p.relative_to(KIT)) for p in KIT.rglob("*/*.py"))):
        (package / name).parent.mkdir(parents=True, exist_ok=True)
        (package / name).write_bytes((KIT / name).read_bytes())
    (package / "scene/__pycache__").write_text("a file where a folder should be")
    code = "from falconwing_kit.scene import fast; print(fast.__file__, fast.clamp(2.0, 0.0, 1.0))"
    nowhere = {"HOME": os.devnull, "XDG_CACHE_HOME": os.devnull, "PYTHONPATH": str(tmp_path)}
    environment = {k: v for k, v in os.environ.items() if k != "NUMBA_CACHE_DIR"} | nowhere
    done = subprocess.run(
        [sys.executable, "-c", code], env=environment, cwd=tmp_path, capture_output=True, text=True
    )
    assert done.stdout.split() == [str(package / "scene/fast.py"), "1.0"], done.stderr


@pytest.mark.parametrize(
    ("argument", "words"),
    [
        ({"T_world_camera": np.eye(3)}, r"T_world_camera: expected shape \(4, 4\)"),
        ({"background": (1.0, 1.0)}, r"background: expected shape \(3\)"),
        ({"threads": 0}, "threads: expected a finite number"),
    ],
)
def test_bad_arguments_are_refused_in_one_sentence(argument, words):
    """The rule of the house: name, expected, got."""
    with pytest.raises(InputError, match=words):
        render_fast(
            **{"scene": random_scene(0), "camera": SMALL, "T_world_camera": AHEAD} | argument
        )
