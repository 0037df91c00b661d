"""Edits keep their laws: motions and light by hand, what is added can be taken out, nothing else
changes.
"""

import numpy as np
import pytest

from falconwing_kit.core.checks import InputError
from falconwing_kit.core.frames import pose_matrix, rotation_world_body
from falconwing_kit.scene import GaussianScene, PinholeCamera, nose_camera_pose, render
from falconwing_kit.scene.edit import (
    Appearance,
    add,
    apply_appearance,
    delete,
    draw_appearance,
    duplicate,
    move,
    relight,
    rename,
    rotate,
    salt_and_pepper,
    scale,
    select_gaussians,
    translate,
)

CAMERA = PinholeCamera.from_fov_deg(96, 72, 70.0)
ARRAYS = ("means", "quaternions", "scales", "opacities", "sh", "labels")
C0 = 0.28209479177387814  # 1 / (2 sqrt(pi))
TURN = rotation_world_body(0.7, -0.4, 2.1)


@pytest.fixture
def rng():
    return np.random.default_rng(11)


def cloud(rng, count, middle, label, degree=3):
    """Coloured Gaussians around a place, seen differently from every side."""
    sh = rng.normal(size=(count, (degree + 1) ** 2, 3)) * 0.2
    sh[:, 0] += 0.3
    return GaussianScene(
        middle + 0.15 * rng.normal(size=(count, 3)),
        rng.normal(size=(count, 4)),
        rng.uniform(0.01, 0.08, (count, 3)),
        rng.uniform(0.3, 0.95, count),
        sh,
        (),
        (label,),
    )


@pytest.fixture
def scene(rng):
    """A hall of two kinds of things."""
    return GaussianScene.joined(
        cloud(rng, 40, (3.0, 0.5, 1.0), "pad"), cloud(rng, 30, (4.0, -0.5, 1.2), "wall")
    )


@pytest.fixture
def asset(rng):
    """An aircraft, near the origin as in its body axes."""
    return cloud(rng, 25, (0.0, 0.0, 0.0), "leader")


def everything(scene):
    return np.ones(len(scene), bool)


def same(first, second, names=ARRAYS):
    return all(np.array_equal(getattr(first, name), getattr(second, name)) for name in names)


def bits(scene):
    return {name: getattr(scene, name).copy() for name in ARRAYS}


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_turning_asset_and_camera_together_leaves_the_image(rng, degree):
    """A law of rigid motion; 1e-4 is some roundings of 32 bits. Colours left unturned are off by
    more than 0.01.
    """
    asset = cloud(rng, 60, (0.0, 0.0, 0.0), "leader", degree)
    T_world_camera = nose_camera_pose((-1.2, 0.1, 0.05), 0.2, 0.1, 0.05)
    motion = pose_matrix(TURN, np.array([3.0, -1.0, 2.0]))
    before = render(asset, CAMERA, T_world_camera, "reference")
    moved = move(asset, everything(asset), motion)
    after = render(moved, CAMERA, motion @ T_world_camera, "reference")
    assert before.alpha.max() > 0.8
    np.testing.assert_allclose(after.rgb, before.rgb, atol=1e-4)
    if degree > 0:
        flat = GaussianScene(
            moved.means, moved.quaternions, moved.scales, moved.opacities, asset.sh
        )
        assert (
            np.abs(
                render(flat, CAMERA, motion @ T_world_camera, "reference").rgb - before.rgb
            ).max()
            > 1e-2
        )


def test_rotation_there_and_back_is_none(scene):
    """R^T R = 1, about the same place; 1e-5 for numbers of a few metres in 32 bits. A quaternion's
    sign is free.
    """
    mask = scene.labelled("pad")
    back = rotate(rotate(scene, mask, TURN, (1.0, 2.0, 3.0)), mask, TURN.T, (1.0, 2.0, 3.0))
    np.testing.assert_allclose(back.means, scene.means, atol=1e-5)
    np.testing.assert_allclose(back.sh, scene.sh, atol=1e-5)
    np.testing.assert_allclose(
        np.abs(np.sum(back.quaternions * scene.quaternions, axis=1)), 1.0, atol=1e-5
    )


def test_quarter_turn_about_a_place_by_hand():
    """By hand: about (1, 0, 0), a quarter turn from x to y takes (3, 0, 0) to (1, 2, 0), and a long
    x axis to y.
    """
    one = GaussianScene([[3, 0, 0]], [[1, 0, 0, 0]], [[0.4, 0.1, 0.2]], [0.9], np.zeros((1, 1, 3)))
    turned = rotate(one, everything(one), [[0, -1, 0], [1, 0, 0], [0, 0, 1]], (1.0, 0.0, 0.0))
    np.testing.assert_allclose(turned.means, [[1.0, 2.0, 0.0]], atol=1e-6)
    np.testing.assert_allclose(
        turned.quaternions, [[np.sqrt(0.5), 0.0, 0.0, np.sqrt(0.5)]], atol=1e-6
    )


def test_a_part_turns_where_it_is_unless_a_centre_is_given(rng):
    """By hand: two Gaussians at x = 2 and 4 have their middle at 3, and half a turn about z swaps
    them.
    """
    pair = GaussianScene(
        [[2, 1, 0], [4, 1, 0]],
        [[1, 0, 0, 0]] * 2,
        np.full((2, 3), 0.1),
        [0.9] * 2,
        np.zeros((2, 1, 3)),
    )
    np.testing.assert_allclose(
        rotate(pair, everything(pair), np.diag([-1.0, -1.0, 1.0])).means,
        pair.means[::-1],
        atol=1e-6,
    )


def test_deleting_what_was_added_gives_the_same_bits_back(scene, asset):
    """A law; the name goes with it, and the numbers of the other labels stay."""
    both = add(scene, asset, "leader")
    assert len(both) == len(scene) + len(asset)
    back = delete(both, select_gaussians(both, "leader"))
    assert same(back, scene) and back.label_names == scene.label_names


def test_labels_close_up_when_the_first_goes(scene):
    """By hand: without the pad, the wall is the only kind, number 0."""
    left = delete(scene, scene.labelled("pad"))
    assert left.label_names == ("wall",) and not left.labels.any() and len(left) == 30
    assert np.array_equal(left.means, scene.means[scene.labelled("wall")])


def test_an_asset_of_lower_degree_is_padded(scene, rng):
    """Zeros for what it lacks: its image stays."""
    flat = cloud(rng, 10, (2.0, 0.0, 1.0), "ball", degree=0)
    both = add(scene, flat)
    assert both.sh.shape[1] == 16 and not both.sh[both.labelled("ball"), 1:].any()


def test_duplicate_at_a_distance_is_seen_twice(rng):
    """Geometry: at the same depth, 1 m to the left is f / depth px to the left; the same image
    there, to 1e-4.
    """
    camera = PinholeCamera(80.0, 80.0, 80.0, 40.0, 160, 80)
    asset = cloud(rng, 30, (0.0, 0.0, 0.0), "leader", degree=0)
    scene = translate(asset, everything(asset), (4.0, -1.0, 1.0))
    twice = duplicate(scene, everything(scene), (0.0, 2.0, 0.0), "copy")  # 2 m * 80 / 4 m = 40 px
    pose = nose_camera_pose((0.0, 0.0, 1.0), 0.0, 0.0, 0.0)
    one, two = (render(each, camera, pose, "reference") for each in (scene, twice))
    assert one.alpha[:, 80:].max() > 0.5 and one.alpha[:, :80].max() < 1e-3
    assert two.alpha.sum() == pytest.approx(
        2.0 * one.alpha.sum(), rel=0.1
    )  # off its axis a cloud is seen from aside
    columns = (np.arange(160) + 0.5) * two.alpha.sum(axis=0)
    places = [
        columns[part].sum() / two.alpha[:, part].sum() for part in (slice(0, 80), slice(80, 160))
    ]
    assert places[1] - places[0] == pytest.approx(40.0, abs=1.0)
    assert twice.label_names == ("leader", "copy") and same(
        twice.selected(twice.labelled("leader")), scene
    )


@pytest.mark.parametrize("factor", [2.0, 0.5])
def test_scale_changes_the_apparent_size_at_the_same_distance(rng, factor):
    """Pinhole: a disc across the view at 5 m is f s r / 5 m wide; its area goes with s^2. 3 % for
    blur and pixels.
    """
    points = rng.uniform(-1, 1, (400, 2))
    points = points[np.hypot(*points.T) < 1.0] * 0.5
    means = np.column_stack([np.full(len(points), 5.0), points + np.array([0.0, 1.0])])
    count = len(means)
    disc = GaussianScene(
        means,
        [[1, 0, 0, 0]] * count,
        [[0.001, 0.06, 0.06]] * count,
        [0.99] * count,
        np.zeros((count, 1, 3)),
    )
    camera, pose = (
        PinholeCamera(400, 400, 200, 200, 400, 400),
        nose_camera_pose((0, 0, 1.0), 0, 0, 0),
    )
    sized = scale(disc, everything(disc), factor, (5.0, 0.0, 1.0))
    widths = []
    for each in (disc, sized):
        solid = render(each, camera, pose, "fast").alpha > 0.5
        widths.append(np.ptp(np.nonzero(solid)[1]) + 1)
    assert widths[1] / widths[0] == pytest.approx(factor, rel=0.03)


@pytest.mark.parametrize("degree", [0, 2])
def test_relight_scales_linear_light(rng, degree):
    """Over black, light is the 2.2th power of what a screen shows; three quarters of it, and red a
    third of that.

    Factors below 1 keep all below the white that `render` cuts at; 1e-4 for 32 bits.
    """
    asset = cloud(rng, 40, (2.0, 0.0, 1.0), "leader", degree)
    pose = nose_camera_pose((0.0, 0.0, 1.0), 0.0, 0.0, 0.0)
    dim = relight(asset, everything(asset), 0.5)
    redder = relight(dim, everything(dim), 0.75, (1.0 / 3.0, 1.0, 1.0))
    before, after = (render(each, CAMERA, pose, "reference").rgb for each in (dim, redder))
    assert 0.2 < before.max() < 1.0
    np.testing.assert_allclose(after**2.2, before**2.2 * (0.25, 0.75, 0.75), atol=1e-4)


def test_salt_and_pepper_is_a_share_of_black_and_white(scene):
    """By hand: 30 % of 40 are 12; their colour is 0 or 1 from every side, both occur, and the
    others keep theirs.
    """
    mask = scene.labelled("pad")
    noisy = salt_and_pepper(scene, mask, 0.3, seed=4)
    hit = (noisy.sh != scene.sh).any(axis=(1, 2))
    assert hit.sum() == 12 and mask[hit].all()
    grey = 0.5 + C0 * noisy.sh[hit, 0]
    assert np.allclose(grey, np.round(grey)[:, :1], atol=1e-6) and set(np.round(grey[:, 0])) == {
        0.0,
        1.0,
    }
    assert not noisy.sh[hit, 1:].any()
    assert same(noisy, salt_and_pepper(scene, mask, 0.3, seed=4))
    assert not same(noisy, salt_and_pepper(scene, mask, 0.3, seed=5))


def test_appearances_stay_in_their_ranges_and_repeat(scene):
    """The paper's: half to double size, noise on up to 30 %. In the mean of logarithms size stays
    (0.4 / sqrt(200)).
    """
    looks = [draw_appearance(seed) for seed in range(200)]
    values = np.array([(look.scale, look.brightness, look.salt_pepper) for look in looks])
    assert (values >= (0.5, 0.4, 0.0)).all() and (values <= (2.0, 1.6, 0.3)).all()
    assert abs(np.log(values[:, 0]).mean()) < 3 * 0.4 / np.sqrt(200)
    assert looks[7] == draw_appearance(7) and looks[7] != looks[8]


def test_dress_is_its_three_steps(scene):
    """Size, light and noise one after the other, about a place of our own; the rest of the scene
    keeps its bits.
    """
    mask, look, place = scene.labelled("pad"), Appearance(1.5, 0.8, 0.2, 3), (3.0, 0.0, 1.0)
    dressed = apply_appearance(scene, mask, look, place)
    expected = salt_and_pepper(relight(scale(scene, mask, 1.5, place), mask, 0.8), mask, 0.2, 3)
    assert same(dressed, expected)
    np.testing.assert_allclose(
        dressed.means[mask] - place, 1.5 * (scene.means[mask] - np.array(place)), atol=1e-5
    )
    assert same(dressed.selected(~mask), scene.selected(~mask))


EDITS = {
    "translate": lambda s, m: translate(s, m, (1.0, 2.0, 3.0)),
    "rotate": lambda s, m: rotate(s, m, TURN),
    "scale": lambda s, m: scale(s, m, 2.0),
    "relight": lambda s, m: relight(s, m, 2.0),
    "salt_and_pepper": lambda s, m: salt_and_pepper(s, m, 0.5),
    "rename": lambda s, m: rename(s, m, "other"),
    "duplicate": lambda s, m: duplicate(s, m, (1.0, 0.0, 0.0), "other"),
    "delete": lambda s, m: delete(s, m),
}


@pytest.mark.parametrize("name", EDITS)
def test_an_edit_changes_its_part_alone_and_the_old_scene_never(scene, name):
    """Frozen means frozen: not a bit of what came in, nor of what was not chosen."""
    mask, before = scene.labelled("pad"), bits(scene)
    edited = EDITS[name](scene, mask)
    assert all(np.array_equal(before[key], getattr(scene, key)) for key in ARRAYS)
    wall = edited.selected(edited.labelled("wall"))
    assert same(wall, scene.selected(scene.labelled("wall")), ARRAYS[:-1])
    assert len(edited) != len(scene) or not same(edited, scene)


@pytest.mark.parametrize("name", EDITS)
@pytest.mark.parametrize("mask", [np.zeros(70, bool), np.ones(3, bool), np.ones(70)])
def test_a_mask_that_is_none_is_refused(scene, name, mask):
    """Nothing chosen, of another length, not of True and False."""
    with pytest.raises(InputError, match="mask"):
        EDITS[name](scene, mask)


@pytest.mark.parametrize(
    ("edit", "text"),
    [
        (lambda s, m: scale(s, m, 0.0), "factor"),
        (lambda s, m: scale(s, m, -2.0), "factor"),
        (lambda s, m: scale(s, m, 2.0, (0.0, np.nan, 0.0)), "about_world"),
        (lambda s, m: translate(s, m, (1.0, np.inf, 0.0)), "offset_world"),
        (lambda s, m: translate(s, m, (1.0, 2.0)), "offset_world"),
        (lambda s, m: rotate(s, m, 2.0 * np.eye(3)), "rotation"),
        (lambda s, m: rotate(s, m, np.diag([1.0, 1.0, -1.0])), "mirrors"),
        (lambda s, m: relight(s, m, -0.1), "brightness"),
        (lambda s, m: relight(s, m, 1.0, (1.0, 1.0)), "gain"),
        (lambda s, m: salt_and_pepper(s, m, 1.1), "share"),
        (lambda s, m: salt_and_pepper(s, m, 0.1, -1), "seed"),
        (lambda s, m: salt_and_pepper(s, m, 0.1, 1.5), "seed"),
        (lambda s, m: draw_appearance(0, scale=(2.0, 0.5)), "scale"),
        (lambda s, m: draw_appearance(0, salt_pepper=(0.0, 1.5)), "salt_pepper"),
        (lambda s, m: delete(s, everything(s)), "cannot be empty"),
        (lambda s, m: duplicate(s, m, (1.0, 0.0, 0.0), "wall"), "new to the scene, got 'wall'"),
        (lambda s, m: rename(s, m, ""), "label_names"),
        (lambda s, m: select_gaussians(s, "leader"), "expected one of pad, wall, got 'leader'"),
        (lambda s, m: select_gaussians(s, "pad", low=(50.0, 0.0, 0.0)), "none called pad"),
    ],
)
def test_a_value_that_is_none_is_refused(scene, edit, text):
    """The sentence names what was wrong."""
    with pytest.raises(InputError, match=text):
        edit(scene, scene.labelled("pad"))


def test_an_asset_without_labels_needs_a_name(scene, asset):
    """A .ply keeps no labels: all of it is called "scene"."""
    plain = GaussianScene(asset.means, asset.quaternions, asset.scales, asset.opacities, asset.sh)
    with pytest.raises(InputError, match="give it a name"):
        add(scene, plain)
    with pytest.raises(InputError, match="one without"):
        select_gaussians(plain, "leader")
    assert add(scene, plain, "leader").labelled("leader").sum() == len(plain)


def test_box_takes_what_lies_in_it(scene):
    """By hand, from the means; an open side takes all."""
    chosen = select_gaussians(scene, low=(3.5, -9.0, -9.0))
    assert np.array_equal(chosen, scene.means[:, 0] >= np.float32(3.5))
    assert np.array_equal(
        select_gaussians(scene, "wall", high=(4.0, 9.0, 9.0)),
        (scene.labels == 1) & (scene.means[:, 0] <= 4.0),
    )
