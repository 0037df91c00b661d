"""Training views: images, depths and poses are consistent with each other."""

import sys
import types

import numpy as np
import pytest
import torch

from falconwing_kit.aircraft.touchdown import LandingPad
from falconwing_kit.core.frames import euler_from_rotation
from falconwing_kit.learning import pose_views
from falconwing_kit.learning.pose_views import (
    aircraft_poses,
    approach_poses,
    draw_leader,
    make_renderer,
    overlay_photos,
    perturb_poses,
    sample_views,
    upscale_camera,
)
from falconwing_kit.scene import GaussianScene, gsplat_backend, load_scene, nose_camera_pose
from falconwing_kit.vision.pose_net import cell_rays
from tests.learning.halls import CAMERA, HIGH, LOW, hall, photos_of, world
from tests.scene.test_gsplat_backend import rasterization

AHEAD = nose_camera_pose((-5.0, -1.0, 1.5), 0.1, -0.1, 0.2)


def points_seen(views):
    """(N, K, 3) where the cells' rays end, by depth along the camera's axis."""
    rays, T = cell_rays(CAMERA), views.Ts_world_camera.numpy().astype(np.float64)
    reach = views.depths.numpy()[..., None] / rays[:, 2:]
    return T[:, None, :3, 3] + reach * np.einsum("nij,kj->nki", T[:, :3, :3], rays)


def test_cells_end_on_the_hall():
    """The arena's floor is at 0, its ceiling at 5 m, its walls at its box: what a cell sees lies on
    one of them or on something between; nine of ten lie within 0.3 m of the shell, for splats blend
    depths at edges.
    """
    views = sample_views(
        world(low=np.array([-20.0, -10, 0.5]), high=np.array([15.0, 6, 4.5])),
        30,
        np.random.default_rng(0),
    )
    points = points_seen(views)[views.depths.numpy() > 0.0]
    low, high = np.array([-22.5, -12.0, 0.0]), np.array([17.5, 8.0, 5.0])
    assert ((points > low - 0.3) & (points < high + 0.3)).mean() > 0.98
    shell = np.minimum(np.abs(points - low), np.abs(points - high)).min(axis=1)
    assert (shell < 0.3).mean() > 0.8


def test_depths_of_a_floor_are_those_of_its_rays():
    """By hand 1.5 m above a floor: a ray that falls by d per metre reaches it at 1.5 / d; half a
    piece is 5 cm.
    """
    x, y = (axis.ravel() for axis in np.meshgrid(np.arange(-3, 3, 0.1), np.arange(-4, 4, 0.1)))
    flat = np.tile([0.06, 0.06, 0.001], (len(x), 1))
    means = np.stack([x, y, 0.0 * x], axis=1)
    floor = GaussianScene(
        means,
        np.tile([1, 0, 0, 0], (len(x), 1)),
        flat,
        np.full(len(x), 0.99),
        np.zeros((len(x), 1, 3)),
    )
    T_world_camera = nose_camera_pose((-2.0, 0.5, 1.5), 0.2, np.radians(-50.0), 0.3)
    flying = world(
        render_hall=make_renderer(floor, upscale_camera(CAMERA), "fast"),
        photos=photos_of([T_world_camera]),
        photo_share=1.0,
    )
    views = sample_views(flying, 3, np.random.default_rng(2))
    rays = cell_rays(CAMERA)
    for depths, T in zip(views.depths.numpy(), views.Ts_world_camera.numpy(), strict=True):
        fall = -(rays / rays[:, 2:] @ T[:3, :3].T)[:, 2]
        known = depths > 0.0
        assert known.mean() > 0.5
        assert np.median(np.abs(depths - 1.5 / fall)[known]) < 0.05


def test_aircraft_are_anywhere_in_the_box_and_head_anywhere():
    """By the documented distribution: inside by half a metre, roll 25 and pitch 12 deg, every
    quadrant of headings.
    """
    Ts = aircraft_poses(LOW, HIGH, 4000, np.random.default_rng(0))
    assert (Ts[:, :3, 3] >= LOW + 0.5).all()
    assert (Ts[:, :3, 3] <= HIGH - 0.5).all()
    R_body_from_camera = np.array(
        [[0.0, 1, 0], [0, 0, 1], [1, 0, 0]]
    )  # right, down, forward -> nose, wing, belly
    roll, pitch, yaw = euler_from_rotation(Ts[:, :3, :3] @ R_body_from_camera)
    assert np.degrees(roll.std()) == pytest.approx(25.0, rel=0.05)
    assert np.degrees(pitch.std()) == pytest.approx(12.0, rel=0.05)
    assert np.histogram(yaw, 4, (-np.pi, np.pi))[0].min() > 900


def test_approaches_are_low_along_the_pad():
    """By the documented distribution: from 8 m before a pad 12 m long and 6 cm high, within 1.5 m
    of its centre line, 8 cm to 1.2 m above it; along it with 8 deg, roll 8 and pitch 5 deg.
    """
    pad = LandingPad(x_start=2.0, y_centre=-3.0, length=12.0, height=0.06)
    Ts = approach_poses(pad, 4000, np.random.default_rng(0))
    assert (Ts[:, :3, 3] >= (-6.0, -4.5, 0.14)).all()
    assert (Ts[:, :3, 3] <= (14.0, -1.5, 1.26)).all()
    R_body_from_camera = np.array([[0.0, 1, 0], [0, 0, 1], [1, 0, 0]])
    turns = np.degrees(euler_from_rotation(Ts[:, :3, :3] @ R_body_from_camera))
    assert turns.std(axis=1) == pytest.approx([8.0, 5.0, 8.0], rel=0.05)
    assert np.abs(turns.mean(axis=1)).max() < 0.5


def test_views_of_approaches_are_kept_down_to_the_pad():
    """A floor without holes, so that no view shows too little; 15 cm above it a fifth of the pixels
    and more are nearer than an obstacle may be, and all views stay all the same.
    """
    pieces = np.stack(np.meshgrid(np.arange(-8, 22, 0.25), np.arange(-8, 4, 0.25)), -1)
    means = np.concatenate([pieces.reshape(-1, 2), np.zeros((pieces[..., 0].size, 1))], axis=1)
    sky = np.array([[30.0, -2.0, 5.0]])
    floor = GaussianScene(
        np.concatenate([means, sky]),
        np.tile([1, 0, 0, 0], (len(means) + 1, 1)),
        np.concatenate([np.tile([0.15, 0.15, 0.001], (len(means), 1)), [[0.1, 50.0, 50.0]]]),
        np.full(len(means) + 1, 0.99),
        np.zeros((len(means) + 1, 1, 3)),
    )
    low_flying = world(
        render_hall=make_renderer(floor, upscale_camera(CAMERA), "fast"),
        pad=LandingPad(),
        approach_share=1.0,
    )
    views = sample_views(low_flying, 60, np.random.default_rng(1))
    heights = views.Ts_world_camera[:, 2, 3].numpy()
    assert len(views.images) == 60 and np.sum(heights < 0.3) > 3


def test_perturbation_has_the_given_sigmas():
    """Normal with 0.7 m per axis; a turn of 10 deg about each axis is one of sqrt(3) x 10 deg, root
    mean square.
    """
    moved = perturb_poses(np.tile(AHEAD, (4000, 1, 1)), 0.7, 10.0, np.random.default_rng(0))
    assert (moved[:, :3, 3] - AHEAD[:3, 3]).std() == pytest.approx(0.7, rel=0.03)
    cos = 0.5 * (np.einsum("nij,ij->n", moved[:, :3, :3], AHEAD[:3, :3]) - 1.0)
    assert np.degrees(np.sqrt((np.arccos(cos) ** 2).mean())) == pytest.approx(17.3, rel=0.03)


def test_a_rotated_photo_equals_the_render_there():
    """The hall rendered from the turned pose is the independent truth: 20 dB are left after
    resampling at few pixels.

    Turned the wrong way it is 6 dB less or worse; not turned at all, the photo itself comes back to
    a byte's step.
    """
    photos, render_hall = photos_of([AHEAD]), make_renderer(hall(), upscale_camera(CAMERA), "fast")
    turned = perturb_poses(AHEAD[None], 0.0, 6.0, np.random.default_rng(4))
    back = turned.copy()
    back[0, :3, :3] = AHEAD[:3, :3] @ turned[0, :3, :3].T @ AHEAD[:3, :3]
    truth, decibels = render_hall(turned)[0], []
    for T in (turned, back):
        drawn = overlay_photos(torch.full_like(truth, -1.0), CAMERA, T, photos, np.array([0]))
        seen = (drawn >= 0.0).all(dim=-1)
        assert 0.6 < seen.float().mean() < 1.0
        decibels.append(-10.0 * torch.log10(((drawn - truth)[seen] ** 2).mean()))
    assert decibels[0] > max(20.0, decibels[1] + 6.0)
    still = overlay_photos(truth, CAMERA, AHEAD[None], photos, np.array([0]))
    assert (still - render_hall(AHEAD[None])[0]).abs().max() < 0.01


def test_photos_and_their_neighbourhood_are_taken():
    """With all shares on photos every place is a photo's; with all beside them every place is near
    one.
    """
    photos = photos_of([AHEAD])
    exact = sample_views(
        world(photos=photos, photo_share=1.0, near_share=0.0), 6, np.random.default_rng(0)
    )
    assert len(exact.images) == 6
    assert np.allclose(exact.Ts_world_camera[:, :3, 3], AHEAD[:3, 3])
    near = sample_views(
        world(photos=photos, photo_share=0.0, near_share=1.0), 6, np.random.default_rng(0)
    )
    distances = np.linalg.norm(near.Ts_world_camera[:, :3, 3].numpy() - AHEAD[:3, 3], axis=1)
    assert 0.1 < distances.mean() < 3.0


def test_a_leader_hides_the_hall_only_where_nothing_hides_it():
    """A leader 1.5 to 12 m ahead is seen against a hall 100 m away, and not at all through a wall
    at 0.5 m.
    """
    render_hall = make_renderer(load_scene("leader"), upscale_camera(CAMERA), "fast")
    counts = []
    for distance in (100.0, 0.5):
        colours, depths = torch.zeros(8, 96, 128, 3), torch.full((8, 96, 128), distance)
        draw_leader(
            colours,
            depths,
            render_hall,
            CAMERA,
            np.tile(AHEAD, (8, 1, 1)),
            np.arange(8),
            np.random.default_rng(0),
        )
        counts.append(int((depths == 0.0).sum()))
        assert ((colours.sum(dim=-1) > 0.0) | (depths > 0.0)).all()
    assert counts[0] > 50
    assert counts[1] == 0


@pytest.mark.parametrize(("alpha", "depth"), [(0.0, 0.0), (1.0, 0.2)])
def test_views_that_show_no_hall_are_left_out(alpha, depth):
    """A renderer that sees nothing, and one with its nose at a wall: none of their views counts."""

    def render_hall(Ts_world_camera):
        empty = torch.ones(len(Ts_world_camera), 96, 128)
        return torch.zeros(*empty.shape, 3), alpha * empty, depth * empty

    assert (
        len(sample_views(world(render_hall=render_hall), 5, np.random.default_rng(0)).images) == 0
    )


def test_gsplat_s_way_gives_what_the_reference_gives(monkeypatch):
    """A stand-in with gsplat's signature draws by the reference: colours, alpha and depth must come
    back in place.
    """
    monkeypatch.setitem(sys.modules, "gsplat", types.SimpleNamespace(rasterization=rasterization))
    monkeypatch.setattr(gsplat_backend, "DEVICE", "cpu")
    monkeypatch.setattr(pose_views, "BATCH", 2)  # five views in three calls
    few = hall().selected(np.random.default_rng(0).random(len(hall())) < 0.01)
    Ts = perturb_poses(np.tile(AHEAD, (5, 1, 1)), 0.7, 10.0, np.random.default_rng(0))
    ours, theirs = (make_renderer(few, CAMERA, backend)(Ts) for backend in ("gsplat", "reference"))
    for actual, expected in zip(ours, theirs, strict=True):
        assert actual.shape == expected.shape
        assert torch.allclose(actual, expected, atol=1e-4)


def test_the_same_seed_draws_the_same_views():
    """A second run must be able to repeat a first."""
    first, second = (sample_views(world(), 4, np.random.default_rng(7)) for _ in range(2))
    assert all(torch.equal(a, b) for a, b in zip(first, second, strict=True))
