"""The gsplat backend where there is no GPU: its sentences, and its arguments by a stand-in for the
library.

The real library is compared in tests/benchmarks/bench_gsplat_backend.py.
"""

import sys
import types
from dataclasses import replace
from functools import lru_cache

import numpy as np
import pytest
import torch

from falconwing_kit.core.checks import InputError
from falconwing_kit.scene import (
    GaussianScene,
    PinholeCamera,
    gsplat_backend,
    nose_camera_pose,
    render,
    render_batch,
)
from falconwing_kit.scene.reference import GaussianTensors, render_reference, render_tensors

CAMERA = PinholeCamera(50.0, 60.0, 7.5, 5.0, 16, 11)
POSE = nose_camera_pose((0.5, 0.1, 1.0), 0.2, 0.05, 0.1)


def scene():
    rng = np.random.default_rng(6)
    means = rng.normal(size=(20, 3)) * 0.2 + (2.5, 0.0, 1.0)
    quaternions, scales = rng.normal(size=(20, 4)), rng.uniform(0.05, 0.2, (20, 3))
    return GaussianScene(
        means, quaternions, scales, rng.uniform(0.3, 0.9, 20), rng.normal(size=(20, 9, 3)) * 0.1
    )


def rasterization(
    means,
    quats,
    scales,
    opacities,
    colors,
    viewmats,
    Ks,
    width,
    height,
    sh_degree=None,
    packed=True,
    backgrounds=None,
    render_mode="RGB",
    rasterize_mode="classic",
):
    """gsplat 1.5.3's function with its names, shapes and frames, as its documentation has them,
    drawn in torch.
    """
    assert render_mode == "RGB+ED" and colors.shape[1] == (sh_degree + 1) ** 2
    assert (
        viewmats.shape[1:] == (4, 4)
        and Ks.shape[1:] == (3, 3)
        and backgrounds.shape == (len(viewmats), 3)
    )
    tensors = GaussianTensors(means, quats, scales, opacities, colors)
    colours, alphas = [], []
    for viewmat, K, background in zip(viewmats, Ks, backgrounds, strict=True):
        camera = PinholeCamera(
            K[0, 0].item(), K[1, 1].item(), K[0, 2].item(), K[1, 2].item(), width, height
        )
        pose = torch.linalg.inv(viewmat)
        rgb, alpha, depth = render_tensors(
            tensors, camera, pose, background, rasterize_mode == "antialiased"
        )
        colours.append(torch.cat([rgb, depth[..., None]], dim=-1))
        alphas.append(alpha[..., None])
    return torch.stack(colours), torch.stack(alphas), {}


@pytest.fixture
def stand_in(monkeypatch):
    """A module gsplat that renders on the CPU; what was remembered of the real one is forgotten
    before and after.
    """
    gsplat = types.ModuleType("gsplat")
    gsplat.rasterization = rasterization
    monkeypatch.setitem(sys.modules, "gsplat", gsplat)
    monkeypatch.setattr(gsplat_backend, "DEVICE", "cpu")
    forget()
    yield gsplat
    forget()


def forget():
    gsplat_backend.probe_gsplat.cache_clear()
    gsplat_backend._tensors.cache_clear()


@pytest.mark.parametrize("antialiased", [False, True])
def test_arguments_reach_gsplat_in_its_frames(stand_in, antialiased):
    """The stand-in inverts the view matrix and draws with the reference, which gsplat's own images
    have tested.
    """
    background = (0.1, 0.2, 0.3)
    frame = render(scene(), CAMERA, POSE, "gsplat", background, antialiased)
    expected = render_reference(scene(), CAMERA, POSE, background, antialiased)
    assert expected[1].max() > 0.5
    for image, wanted in zip((frame.rgb, frame.alpha, frame.depth), expected, strict=True):
        assert image.dtype == np.float32 and image.shape == wanted.shape
        assert image.flags.c_contiguous
        assert np.allclose(image, wanted, atol=1e-4)  # the pose is inverted twice in float32


def test_many_poses_go_in_one_call(stand_in):
    """Each image of a batch is the one that its pose gives alone."""
    poses = [POSE, nose_camera_pose((0.3, 0.1, 1.0), 0, 0, 0)]
    colours, alphas = gsplat_backend.rasterize(scene(), CAMERA, poses, (0.0, 0.0, 0.0), False)
    assert colours.shape == (2, 11, 16, 4) and alphas.shape == (2, 11, 16, 1)
    for pose, colour, alpha in zip(poses, colours, alphas, strict=True):
        rgb, covered, _ = render_reference(scene(), CAMERA, pose, (0.0, 0.0, 0.0))
        assert np.allclose(colour[..., :3].numpy(), rgb, atol=1e-4)
        assert np.allclose(alpha[..., 0].numpy(), covered, atol=1e-4)


@pytest.mark.parametrize("limit", [1, 1 << 30], ids=["a pose a call", "one call"])
def test_a_batch_is_its_poses_one_by_one(stand_in, monkeypatch, limit):
    """`render_batch` equals `render` at each pose, however many poses fit in a call. By hand: a
    colour of 3 is cut at 1.
    """
    monkeypatch.setattr(gsplat_backend, "MAX_CALL_BYTES", limit)
    bright = replace(scene(), sh=scene().sh + 8.0)
    poses = np.array([nose_camera_pose((x, 0.1, 1.0), 0.2, 0.0, 0.1) for x in (0.5, 0.3, 0.0)])
    frames = render_batch(bright, CAMERA, poses, "gsplat", (0.1, 0.2, 0.3))
    assert len(frames) == 3 and frames[0].rgb.max() == 1.0
    for frame, pose in zip(frames, poses, strict=True):
        alone = render(bright, CAMERA, pose, "gsplat", (0.1, 0.2, 0.3))
        for name in ("rgb", "alpha", "depth"):
            assert np.array_equal(getattr(frame, name), getattr(alone, name))
    assert not np.array_equal(frames[0].rgb, frames[1].rgb)


def test_calls_of_gsplat_fit_in_memory():
    """By hand: 20 Gaussians of nine coefficients expand to 20 (27 + 3 + 16) numbers, and 16 x 11
    pixels to 1760: 10,720 bytes a pose, of which 100,162 fit in 2^30.
    """
    assert gsplat_backend.poses_per_call((scene(),), CAMERA) == 100_162
    huge = PinholeCamera(9.0, 9.0, 8.0, 8.0, 16384, 16384)
    assert gsplat_backend.poses_per_call((scene(),), huge) == 1


def test_several_scenes_are_joined_on_the_gpu(stand_in, monkeypatch):
    """A moving aircraft in a fixed hall, colours of another degree: the joined scene's image, and
    the hall goes to the GPU once for all images.
    """
    monkeypatch.setattr(
        GaussianScene, "joined", lambda *scenes: pytest.fail("joined on the processor")
    )
    uploaded = count_uploads(monkeypatch)
    hall = scene()
    for x in (1.5, 1.7):
        leader = GaussianScene(
            [[x, 0.1, 1.0]], [[1, 0, 0, 0]], [[0.1] * 3], [0.9], np.ones((1, 1, 3))
        )
        frame = render((hall, leader), CAMERA, POSE, "gsplat")
        rgb, alpha, _ = render_reference(joined_by_hand(hall, leader), CAMERA, POSE, np.zeros(3))
        assert np.allclose(frame.rgb, rgb.clip(0.0, 1.0), atol=1e-4)
        assert np.allclose(frame.alpha, alpha, atol=1e-4)
    assert [one is hall for one in uploaded].count(True) == 1


def count_uploads(monkeypatch):
    """The scenes that go to the GPU from now on, in their order."""
    uploaded = []
    upload = gsplat_backend._tensors.__wrapped__

    def counted(one):
        uploaded.append(one)
        return upload(one)

    monkeypatch.setattr(gsplat_backend, "_tensors", lru_cache(maxsize=4)(counted))
    return uploaded


def joined_by_hand(hall, leader):
    """Both in one scene, the leader's colours filled up with zeros."""
    sh = np.concatenate([hall.sh, np.pad(leader.sh, ((0, 0), (0, 8), (0, 0)))])
    names = ("means", "quaternions", "scales", "opacities")
    return GaussianScene(
        *(np.concatenate([getattr(hall, n), getattr(leader, n)]) for n in names), sh
    )


def test_a_scene_goes_to_the_gpu_once(stand_in):
    """The loop draws the same scene 20 times a second; another scene of the same numbers is another
    scene.
    """
    one = scene()
    assert gsplat_backend._tensors(one) is gsplat_backend._tensors(one)
    assert gsplat_backend._tensors(one) is not gsplat_backend._tensors(scene())


def none_instead(*args, **kwargs):
    raise AttributeError("'NoneType' object has no attribute\n 'projection_ewa_3dgs_fused_fwd'")


def black(*args, **kwargs):
    colours, alphas, meta = rasterization(*args, **kwargs)
    return colours, 0.0 * alphas, meta


@pytest.mark.parametrize(
    ("broken", "reason"),
    [(none_instead, "NoneType"), (black, "one of alpha 0")],
    ids=["no kernels", "black"],
)
def test_gsplat_that_cannot_render_is_said_in_one_sentence(stand_in, broken, reason):
    """Without CUDA gsplat fails at its first call; a driver that draws nothing is an error too."""
    stand_in.rasterization = broken
    with pytest.raises(
        InputError,
        match=rf"^backend: expected gsplat to render one Gaussian, got.*{reason}.*'fast' runs",
    ) as caught:
        render(scene(), CAMERA, POSE, backend="gsplat")
    assert "\n" not in str(caught.value)


def test_a_full_gpu_is_said_in_one_sentence(stand_in):
    """torch's own error where the images do not fit, after the one Gaussian of the probe did."""
    render(scene(), CAMERA, POSE, "gsplat")

    def full(*args, **kwargs):
        raise torch.cuda.OutOfMemoryError("CUDA out of memory.\n Tried to allocate 9 GiB")

    stand_in.rasterization = full
    with pytest.raises(
        InputError, match=r"^backend: expected room for 2 images of 16x11"
    ) as caught:
        render_batch(scene(), CAMERA, [POSE, POSE], "gsplat")
    assert "\n" not in str(caught.value)


def test_missing_gsplat_is_said_with_its_remedy(stand_in, monkeypatch):
    """None in sys.modules makes the import fail as if it were not installed."""
    monkeypatch.setitem(sys.modules, "gsplat", None)
    with pytest.raises(InputError, match="pip install torch gsplat"):
        render(scene(), CAMERA, POSE, backend="gsplat")
