"""Fitting scenes: parts by hand, by laws and by other libraries, and small trainings end to end.

The photos are simulated: renders of a small room of coloured surfels that the training does not
see.
"""

import json
import sys
import types
from dataclasses import replace

import numpy as np
import pytest
import torch
from PIL import Image
from scipy.ndimage import gaussian_filter
from scipy.spatial.transform import Rotation

from falconwing_kit.core.checks import InputError
from falconwing_kit.scene import GaussianScene, PinholeCamera, nose_camera_pose, render
from falconwing_kit.scene.reference import GaussianTensors, covariances
from falconwing_kit.tools.capture.fit import (
    FitSettings,
    apply_pose_corrections,
    evaluate_scene,
    fit_folder,
    fit_scene,
    initial_points,
)
from falconwing_kit.tools.capture.photo_files import Reconstruction, write_reconstruction
from falconwing_kit.tools.capture.survey.points import Survey
from falconwing_kit.tools.capture.training import draw as drawing
from falconwing_kit.tools.capture.training.densify import densify, relocation
from falconwing_kit.tools.capture.training.judge import evaluate, psnr
from falconwing_kit.tools.capture.training.loop import drop_gaussians, ssim_batch, train, train_step
from falconwing_kit.tools.capture.training.photos import (
    Photos,
    held_out_photos,
    hold_out_places,
    load_photos,
    read_photo_names,
)
from falconwing_kit.tools.capture.training.ship import contributions, label_scene
from falconwing_kit.tools.capture.training.state import TrainState, initialise
from falconwing_kit.tools.capture.training.task import SceneTrainer
from falconwing_kit.tools.cli.main import main
from falconwing_kit.tools.cli.scene_fit import Fit

CAMERA = PinholeCamera(40.0, 40.0, 32.0, 24.0, 64, 48)
ROOM = np.array([[-3.0, -2.0, 0.0], [3.0, 2.0, 2.5]])
SMALL = FitSettings(
    gaussians=800,
    steps=150,
    exposures=False,
    hold_out=0.15,
    room=tuple(ROOM.ravel()),
    minutes=60.0,
    pose_steps=0,
)


def small_room():
    """Tiles on floor, ceiling and walls of a room of 6 x 4 x 2.5 m, each of a colour of its own."""
    rng, parts = np.random.default_rng(4), []
    for axis in range(3):
        u, v = (k for k in range(3) if k != axis)
        for side in range(2):
            grid = np.stack(
                np.meshgrid(*(np.arange(ROOM[0, k] + 0.25, ROOM[1, k], 0.5) for k in (u, v))), -1
            )
            means = np.empty((grid[..., 0].size, 3))
            means[:, axis], means[:, [u, v]] = ROOM[side, axis], grid.reshape(-1, 2)
            scales = np.full(means.shape, 0.28)
            scales[:, axis] = 0.01
            sh = rng.uniform(-1.5, 1.5, (len(means), 1, 3))
            parts.append(
                GaussianScene(
                    means, np.tile([1.0, 0, 0, 0], (len(means), 1)), scales, [0.99] * len(means), sh
                )
            )
    return GaussianScene.joined(*parts)


def finished_state(photos):
    """A training whose Gaussians are those of the room to the last digit."""
    scene = tensors(small_room())
    state = initialise(
        small_room().means, np.zeros((len(scene.means), 3), np.uint8), photos, 1, "cpu"
    )
    state.values |= {"quaternions": scene.quaternions.clone(), "log_scales": scene.scales.log()}
    state.values |= {"logits": torch.logit(scene.opacities, 1e-4), "dc": scene.sh[:, 0].clone()}
    state.values["rest"][:, : scene.sh.shape[1] - 1] = scene.sh[:, 1:]
    return state


def poses(count, seed=0):
    """Cameras that look along the room from places all over it."""
    rng = np.random.default_rng(seed)
    return [
        nose_camera_pose(
            rng.uniform((-2, -1, 0.8), (0, 1, 1.6)),
            *rng.uniform(-0.2, 0.2, 2),
            rng.uniform(-0.7, 0.7),
        )
        for _ in range(count)
    ]


@pytest.fixture(scope="module")
def taken(tmp_path_factory):
    """24 photos of the room with their poses, and points on its walls."""
    folder, scene, Ts = tmp_path_factory.mktemp("photos"), small_room(), np.array(poses(24))
    for number, T in enumerate(Ts):
        rgb = render(scene, CAMERA, T, "fast").rgb
        Image.fromarray(np.round(255.0 * rgb).astype(np.uint8)).save(folder / f"{number:02}.png")
    names = tuple(f"{number:02}.png" for number in range(24))
    points, _ = initial_points(np.zeros((0, 3)), np.zeros((0, 3), np.uint8), ROOM, 200, 1)
    return Reconstruction(
        CAMERA, names, folder, Ts, points, np.full((200, 3), 128, np.uint8), aligned=True
    )


def tensors(scene):
    return GaussianTensors.from_scene(scene)


def task_of(source, settings, out):
    """A training of the room's photos, not yet begun."""
    points, colours = initial_points(
        source.points, source.colours, ROOM, settings.gaussians // 2, 0
    )
    photos, box = load_photos(source, settings.width), np.stack([ROOM[0] - 1.0, ROOM[1] + 1.0])
    return SceneTrainer(
        photos, drawing.draw_reference, points, colours, box, 3.0, settings, out, lambda _: None
    )


# --- from end to end ---


def test_a_small_training_gains_several_decibels_on_places_it_has_not_seen(taken, tmp_path):
    """The first Gaussians are grey and random; 3 dB is half the mean square error.

    What is judged is the file.
    """
    lines = []
    before = fit_scene(taken, tmp_path / "a", replace(SMALL, steps=1), say=lines.append).figures[
        "held_out"
    ]
    done = fit_scene(taken, tmp_path / "b", SMALL, say=lines.append)
    after = done.figures["held_out"]
    assert after["psnr_db"] > before["psnr_db"] + 5.0 and after["ssim"] > before["ssim"] + 0.2
    assert done.path.is_file() and not (tmp_path / "b" / "training.npz").exists()
    assert (
        json.loads((tmp_path / "b" / "figures.json").read_text())["held_out"]["photos"]
        == after["photos"]
    )
    held = done.figures["photos"]["held_out"]
    assert [row["photo"] for row in after["photos"]] == held and 1 <= len(held) <= 5
    assert (
        abs(done.figures["held_out_by_fast"]["psnr_db"] - after["psnr_db"]) < 0.05
    )  # two renderers, one file
    again = evaluate_scene(done.path, taken, SMALL)
    assert again["psnr_db"] == pytest.approx(done.figures["held_out_by_fast"]["psnr_db"], abs=1e-9)
    assert len(list((tmp_path / "b" / "pairs").glob("*.png"))) == len(held)


def test_a_frame_error_in_the_poses_is_found_out(taken, tmp_path):
    """OpenGL axes taken for OpenCV's, the classic mistake: the cameras look backward, upside down.

    Half the photos have it, so that no other scene explains them all; the training must end several
    dB worse.
    """
    turned = taken.T_world_camera.copy()
    turned[::2] = turned[::2] @ np.diag([1.0, -1.0, -1.0, 1.0])
    short = replace(SMALL, steps=120)
    right = fit_scene(taken, tmp_path / "a", short, say=lambda _: None).figures["trained_on"]
    wrong = fit_scene(
        replace(taken, T_world_camera=turned), tmp_path / "b", short, say=lambda _: None
    )
    assert wrong.figures["trained_on"]["psnr_db"] < right["psnr_db"] - 2.0


def test_wrong_poses_are_corrected_by_what_the_photos_show(taken, tmp_path):
    """The scene is the true one and every pose is turned by its own 0.3 deg: the turns shrink.

    0.3 deg are a fifth of these photos' pixels and the scene learns too, so a quarter less is all
    that is asked; a correction with the wrong sign makes them larger. What all share is no fault of
    theirs and does not count.
    """
    settings = replace(SMALL, steps=150, batch=4, poses=True, hold_out=0.0, exposures=False)
    twists = np.zeros((24, 6))
    twists[:, :3] = np.random.default_rng(3).normal(size=(24, 3)) * np.radians(0.3)
    turned = drawing.apply_twists(
        torch.from_numpy(taken.T_world_camera), torch.from_numpy(twists)
    ).numpy()
    wrong = replace(taken, T_world_camera=turned)
    task, state = task_of(wrong, settings, tmp_path), finished_state(24)
    train(state, task.photos, task.draw, task.config)
    right = apply_pose_corrections(wrong, task.corrected_poses(state)).T_world_camera

    def turns(poses):
        """How far each pose is turned from the truth, beside what all are [rad]."""
        relative = poses[:, :3, :3] @ taken.T_world_camera[:, :3, :3].transpose(0, 2, 1)
        common = Rotation.from_matrix(relative).mean().inv()
        return (common * Rotation.from_matrix(relative)).magnitude()

    assert np.median(turns(right)) < 0.75 * np.median(turns(turned))


def test_held_out_photos_get_poses_that_fit_and_teach_nothing(taken, tmp_path):
    """The true scene, and one held-out photo rotated by 0.3 deg: half of that at most is left.

    A wrong sign would double it. Poses that training has not moved and the scene's numbers stay as
    they are.
    """
    twist = torch.zeros(24, 6, dtype=torch.float64)
    twist[5, 1] = np.radians(0.3)
    turned = drawing.apply_twists(torch.from_numpy(taken.T_world_camera), twist).numpy()
    settings = replace(SMALL, poses=True, judge_by=(taken.names[5],), pose_steps=80)
    task, state = (
        task_of(replace(taken, T_world_camera=turned), settings, tmp_path),
        finished_state(23),
    )
    before = {name: value.clone() for name, value in state.values.items()}
    found = task.corrected_poses(state)
    left = Rotation.from_matrix(found[5, :3, :3].T @ taken.T_world_camera[5, :3, :3]).magnitude()
    assert left < 0.5 * np.radians(0.3)
    others = np.arange(24) != 5
    assert found[others] == pytest.approx(taken.T_world_camera[others], abs=1e-6)
    assert all(torch.equal(value, before[name]) for name, value in state.values.items())


def test_left_out_gaussians_are_made_up_for():
    """A quarter of 100,000 is missing, within five standard deviations of the binomial.

    The mean stays, as they do.
    """
    opacities = torch.full((100_000,), 0.3)
    thin = drop_gaussians(opacities, 0.25, torch.Generator().manual_seed(0))
    missing = float((thin == 0.0).float().mean())
    assert missing == pytest.approx(0.25, abs=5.0 * (0.25 * 0.75 / 100_000) ** 0.5)
    assert thin[thin > 0.0].unique() == pytest.approx(0.4)
    assert float(thin.mean()) == pytest.approx(0.3, abs=5.0 * 0.4 * (0.25 * 0.75 / 100_000) ** 0.5)
    assert drop_gaussians(opacities, 0.0, torch.Generator()) is opacities


def test_corrected_poses_do_not_move_the_hall(taken):
    """All cameras scaled, rotated and shifted together (scipy's rotation) return to the survey."""
    R = Rotation.from_euler("zyx", [3.0, -2.0, 1.0], degrees=True).as_matrix()
    moved = taken.T_world_camera.copy()
    moved[:, :3, :3] = R @ moved[:, :3, :3]
    moved[:, :3, 3] = 1.03 * moved[:, :3, 3] @ R.T + [0.3, -0.2, 0.1]
    assert apply_pose_corrections(taken, moved).T_world_camera == pytest.approx(
        taken.T_world_camera, abs=1e-9
    )


def test_no_gaussian_grows_beyond_the_largest(taken, tmp_path):
    """0.15 m, where the first ones of this room are up to 0.3 m large.

    Half precision in the file gives 0.1 %.
    """
    done = fit_scene(taken, tmp_path, replace(SMALL, steps=20, largest=0.15), say=lambda _: None)
    assert done.scene.scales.max() < 0.15 * 1.002


def test_photos_to_judge_by_can_be_named(taken, tmp_path):
    """By a list, by lines, and by the figures of another training.

    The folder before a name does not count.
    """
    (tmp_path / "lines.txt").write_text("03.png\nphotos/07.png\n")
    (tmp_path / "list.json").write_text('{"held_out": ["03.png", "07.png"]}')
    (tmp_path / "figures.json").write_text(
        '{"photos": {"held_out": ["03.png", "07.png"]}, "held_out": {}}'
    )
    for name in ("lines.txt", "list.json", "figures.json"):
        settings = FitSettings(judge_by=read_photo_names(tmp_path / name))
        assert np.flatnonzero(
            held_out_photos(taken.names, taken.T_world_camera[:, :3, 3], settings)
        ).tolist() == [3, 7]
    (tmp_path / "other.json").write_text('{"photos": 3}')
    with pytest.raises(InputError, match='expected names of photos under "held_out"'):
        read_photo_names(tmp_path / "other.json")
    with pytest.raises(InputError, match="expected some of the 24 photos, got 0"):
        held_out_photos(
            taken.names, taken.T_world_camera[:, :3, 3], FitSettings(judge_by=("x.png",))
        )


def test_an_interrupted_training_goes_on_as_if_it_had_not_been(taken, tmp_path):
    """Ten steps, or five, a checkpoint and five more, give identical bits."""
    settings = replace(SMALL, gaussians=200, steps=10)
    whole = task_of(taken, settings, tmp_path / "a")
    (learn, _), told = whole.split, "same"
    once = whole.train()
    half = initialise(whole.points, whole.colours, len(learn), 1, "cpu")
    for _ in range(5):
        train_step(half, learn, whole.draw, whole.config, half.step / 10)
        half.step += 1
    half.save(tmp_path / "half.npz", told)
    again = TrainState.load(tmp_path / "half.npz", told, "cpu")
    train(again, learn, whole.draw, whole.config)
    assert again.step == once.step == 10
    for name, value in once.values.items():
        assert torch.equal(value, again.values[name]), name


def test_the_kept_state_is_found_and_other_settings_are_refused(taken, tmp_path):
    """The first call is stopped, the second resumes, a third with other settings is refused."""

    def stop(line):
        if line.startswith("step 10/"):
            raise KeyboardInterrupt

    settings, lines = replace(SMALL, gaussians=100, steps=40), []
    with pytest.raises(KeyboardInterrupt):
        fit_scene(taken, tmp_path, settings, say=stop)
    assert not (tmp_path / "scene.npz").exists()
    with pytest.raises(InputError, match="settings of the interrupted training"):
        fit_scene(taken, tmp_path, replace(settings, seed=5), say=lines.append)
    fit_scene(taken, tmp_path, settings, say=lines.append)
    assert any(
        line.startswith("going on at step 8") for line in lines
    )  # kept every tenth of the way
    (tmp_path / "training.npz").write_bytes(b"PK damaged")
    with pytest.raises(InputError, match="damaged file; delete it"):
        fit_scene(taken, tmp_path, settings, say=lines.append)


def test_time_that_is_up_ends_the_training_early(taken, tmp_path):
    """A thousandth of a second's worth of training is one step; the file comes all the same."""
    task = task_of(taken, replace(SMALL, gaussians=100, minutes=0.01), tmp_path)
    state = train(
        initialise(task.points, task.colours, 24, 1, "cpu"), task.split[0], task.draw, task.config
    )
    assert 0 < state.step < SMALL.steps and state.seconds >= 0.6


# --- the aircraft ---


def aircraft_photos(folder, side=48):
    """RGBA renders of a cross from all sides: body with its nose at x = 0.2 m, wing of 0.7 m."""
    x = np.linspace(-0.3, 0.2, 40)
    y = np.linspace(-0.34, 0.34, 50)
    body = np.stack([x, 0 * x, 0 * x], axis=1)
    means = np.concatenate(
        [body, np.stack([0 * y, y, 0 * y + 0.04], axis=1)]
    )  # z up here: a high wing
    sh = np.concatenate(
        [np.tile([[[1.5, -1.0, -1.0]]], (40, 1, 1)), np.tile([[[-1.0, -1.0, 1.5]]], (50, 1, 1))]
    )
    count = len(means)
    scene = GaussianScene(
        means, np.tile([1.0, 0, 0, 0], (count, 1)), np.full((count, 3), 0.012), [0.95] * count, sh
    )
    camera, frames = PinholeCamera(60.0, 60.0, side / 2, side / 2, side, side), {}
    for number in range(20):
        around, above = 2.4 * number, (-0.5, 0.1, 0.6, 1.1)[number % 4]
        away = np.array(
            [np.cos(around) * np.cos(above), np.sin(around) * np.cos(above), np.sin(above)]
        )
        right = np.cross(-away, (0.0, 0.0, 1.0)) / np.cos(above)
        T = np.eye(4)
        T[:3, :3], T[:3, 3] = np.stack([right, np.cross(-away, right), -away], axis=1), away
        frame = render(scene, camera, T, "fast")
        alpha = frame.alpha[..., None]
        straight = np.where(alpha > 0, frame.rgb / np.maximum(alpha, 1e-3), 0.0)
        pixels = np.concatenate([straight, alpha], axis=2).clip(0.0, 1.0)
        Image.fromarray(np.round(255.0 * pixels).astype(np.uint8)).save(folder / f"{number:03}.png")
        frames[f"{number:03}.png"] = {"T_aircraft_camera": T.tolist()}
    sides = {"fx": 60.0, "fy": 60.0, "cx": side / 2, "cy": side / 2, "width": side, "height": side}
    (folder / "cameras.json").write_text(json.dumps(sides | {"frames": frames}))
    return folder


def test_an_aircraft_comes_out_in_body_axes_with_its_ends(tmp_path):
    """By hand: p_body = diag(1, -1, -1) (p - centre of gravity), with the default centre.

    Nose at 0.2 - 0.036, tail at -0.3 - 0.036, wing tips at y = +-0.34, and the high wing at z =
    -0.04. The last millimetres of a round Gaussian are soft: a pixel is 17 mm wide here, two of
    them are allowed.
    """
    (tmp_path / "photos").mkdir()
    changes = {"gaussians": 300, "steps": 120, "batch": 1}
    done = fit_folder(
        aircraft_photos(tmp_path / "photos"), tmp_path / "out", changes, say=lambda _: None
    )
    points = {name: np.array(p) for name, p in done.figures["points"].items()}
    assert points["nose"][0] == pytest.approx(0.164, abs=0.034)
    assert points["tail"][0] == pytest.approx(-0.336, abs=0.034)
    assert points["right_wing_tip"][1] == pytest.approx(0.34, abs=0.034)
    assert points["left_wing_tip"][1] == pytest.approx(-0.34, abs=0.034)
    assert points["right_wing_tip"][2] == pytest.approx(-0.04, abs=0.02)
    assert done.scene.labelled("leader").all()
    assert (
        done.figures["held_out"]["psnr_db"] > 20.0
    )  # black would have 17: most of each photo is empty


def test_turntable_photos_must_have_alpha(tmp_path):
    """The text names the photo and says what to do."""
    aircraft_photos(tmp_path)
    Image.open(tmp_path / "003.png").convert("RGB").save(tmp_path / "003.png")
    with pytest.raises(
        InputError, match=r"003.png: expected an image with alpha .* cut the object out"
    ):
        fit_folder(tmp_path, tmp_path / "out", {}, say=lambda _: None)


# --- pieces ---


def test_ssim_is_that_of_its_paper():
    """SciPy's Gaussian filter, cut to 11 pixels, gives the same means and variances.

    Its borders are left out.
    """
    rng = np.random.default_rng(0)
    a, b = rng.uniform(size=(30, 40, 3)), rng.uniform(size=(30, 40, 3))

    def blur(image):
        return gaussian_filter(image, (1.5, 1.5, 0.0), truncate=5 / 1.5)[5:-5, 5:-5]

    ma, mb = blur(a), blur(b)
    va, vb, cov = blur(a * a) - ma**2, blur(b * b) - mb**2, blur(a * b) - ma * mb
    expected = (2 * ma * mb + 1e-4) * (2 * cov + 9e-4) / ((ma**2 + mb**2 + 1e-4) * (va + vb + 9e-4))
    assert float(ssim_batch(torch.tensor(a)[None], torch.tensor(b)[None])) == pytest.approx(
        expected.mean(), abs=1e-6
    )
    assert float(ssim_batch(torch.tensor(a)[None], torch.tensor(a)[None])) == pytest.approx(
        1.0, abs=1e-6
    )


def test_ssim_that_is_reported_is_that_of_the_loss():
    """Two ways to one equation: OpenCV's filter on bytes, and torch's matrices.

    Float32 of 255^2 keeps 1e-5.
    """
    images = np.random.default_rng(0).integers(0, 256, (1, 30, 40, 3)).astype(np.uint8)
    render = torch.as_tensor(images / 255.0, dtype=torch.float32).roll(1, dims=2) * 0.7 + 0.2
    camera = PinholeCamera(40.0, 40.0, 20.0, 15.0, 40, 30)
    inside = torch.ones(30, 40, dtype=torch.bool)
    photos = Photos(("a",), camera, torch.as_tensor(images), None, inside, torch.eye(4)[None])
    drawn = (render * 255.0).round() / 255.0
    assert evaluate(lambda poses: render, photos)["ssim"] == pytest.approx(
        float(ssim_batch(drawn, photos.targets(torch.tensor([0]), torch.zeros(3))[0])), abs=1e-5
    )


def test_psnr_by_hand():
    """An error of 0.1 everywhere: -10 log10 0.01 = 20 dB."""
    assert float(psnr(torch.zeros(1, 4, 4, 3), torch.full((1, 4, 4, 3), 0.1))) == pytest.approx(
        20.0, abs=1e-4
    )


def test_copies_share_opacity_and_size_as_the_paper_sums_them():
    """[Kheradmand et al. 2024, eq. 9], its double sum with binomials, written out."""
    from math import comb, sqrt

    for old in (0.1, 0.6, 0.95):
        for n in (1, 2, 3, 6):
            new = 1.0 - (1.0 - old) ** (1.0 / n)
            total = sum(
                comb(i - 1, k) * (-1) ** k * new ** (k + 1) / sqrt(k + 1)
                for i in range(1, n + 1)
                for k in range(i)
            )
            got_new, factor = relocation(torch.tensor([old]).double(), torch.tensor([n]))
            assert float(got_new) == pytest.approx(new, rel=1e-6)
            assert float(factor) == pytest.approx(old / total, rel=1e-5)


def test_growing_leaves_the_picture_as_it_was():
    """Relocation conserves the alpha and its line integral [Kheradmand et al. 2024, eq. 9].

    One Gaussian, 8 pixels wide, becomes five: three dead ones move to it and one is new. The blur
    of 0.3 px^2 and the cut at alpha 1/255, which the law leaves out, are 1 % here.
    """
    state = initialise(
        np.array([[2.0, 0, 0], [2, 9, 0], [2, 9, 9], [2, 9, -9]]),
        np.full((4, 3), 255, np.uint8),
        1,
        0,
        "cpu",
    )
    state.values["logits"] = torch.tensor([1.0, -9.0, -9.0, -9.0])
    state.values["log_scales"][:] = np.log(0.4)
    T = torch.tensor(nose_camera_pose((0, 0, 0), 0, 0, 0), dtype=torch.float32)[None]
    rows = []
    for _ in range(2):
        rows.append(
            drawing.draw_reference(state.gaussians(0), CAMERA, T, torch.zeros(3), False)[1][0, 24]
        )
        densify(state, 10_000, torch.Generator().manual_seed(0))
    assert len(state.values["means"]) == 4 + 1 + 1 and torch.all(
        state.values["means"] == state.values["means"][0]
    )
    assert float(rows[1].max()) == pytest.approx(float(rows[0].max()), rel=0.01)
    assert float(rows[1].sum()) == pytest.approx(float(rows[0].sum()), rel=0.02)


def test_contributions_add_up_to_what_is_covered():
    """A law of compositing: alpha is the sum of all weights, so pixels sum to the sum of alpha."""
    scene, photos = small_room(), types.SimpleNamespace(camera=CAMERA)
    photos.Ts_world_camera = torch.tensor(np.array(poses(3)), dtype=torch.float32)
    pixels = contributions(tensors(scene), photos, drawing.draw_reference, False)
    _, alphas = drawing.draw_reference(
        tensors(scene), CAMERA, photos.Ts_world_camera, torch.zeros(3), False
    )
    assert float(pixels.sum()) == pytest.approx(float(alphas.sum()), rel=1e-4)
    assert (
        float(pixels.min()) == 0.0 and float(pixels.max()) > 10.0
    )  # what is behind the cameras shows nowhere


def test_what_is_held_out_are_whole_places():
    """Ten heaps of four photos, far apart: a heap is held out as a whole or not at all."""
    rng = np.random.default_rng(2)
    heaps = np.repeat(np.arange(10), 4)
    places = (
        np.stack([20.0 * heaps, 0.0 * heaps, 0.0 * heaps], axis=1) + rng.normal(size=(40, 3)) * 0.1
    )
    for seed in range(5):
        held = hold_out_places(places, 0.2, seed)
        assert held.sum() == 8
        assert set(np.bincount(heaps[held], minlength=10)) == {0, 4}
    assert not hold_out_places(places, 0.0).any()
    assert 1 <= hold_out_places(places[:3], 0.11).sum() <= 2


def test_a_twist_moves_a_camera_in_its_own_axes():
    """By hand: 0.3 m along the camera's z is 0.3 m ahead; and SciPy's rotation for the turn."""
    T = torch.tensor(np.array(poses(1)), dtype=torch.float64)
    ahead = drawing.apply_twists(T, torch.tensor([[0, 0, 0, 0, 0, 0.3]], dtype=torch.float64))
    assert torch.allclose(ahead[0, :3, 3] - T[0, :3, 3], 0.3 * T[0, :3, 2], atol=1e-12)
    turned = drawing.apply_twists(
        T, torch.tensor([[0.1, -0.2, 0.05, 0, 0, 0]], dtype=torch.float64)
    )
    expected = T[0, :3, :3].numpy() @ Rotation.from_rotvec([0.1, -0.2, 0.05]).as_matrix()
    assert np.allclose(turned[0, :3, :3], expected, atol=1e-12)
    assert torch.allclose(
        drawing.invert_poses(T) @ T, torch.eye(4, dtype=torch.float64), atol=1e-12
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
    rasterize_mode="classic",
):
    """gsplat 1.5.3's function with its documented names, shapes and frames, drawn in torch."""
    assert (
        colors.shape[1] == (sh_degree + 1) ** 2
        and backgrounds.shape == (len(viewmats), 3)
        and not packed
    )
    fx, fy, cx, cy = (Ks[0][at].item() for at in ((0, 0), (1, 1), (0, 2), (1, 2)))
    given = (
        GaussianTensors(means, quats, scales, opacities, colors),
        PinholeCamera(fx, fy, cx, cy, width, height),
    )
    mode = rasterize_mode == "antialiased"
    rgb, alpha = drawing.draw_reference(*given, torch.linalg.inv(viewmats), backgrounds[0], mode)
    return rgb, alpha[..., None], {}


@pytest.mark.parametrize("antialiased", [False, True])
def test_gsplat_is_asked_for_the_same_picture(monkeypatch, antialiased):
    """A stand-in takes gsplat's arguments and draws by the reference: equal images, gradients."""
    monkeypatch.setitem(sys.modules, "gsplat", types.SimpleNamespace(rasterization=rasterization))
    Ts, background = (
        torch.tensor(np.array(poses(2)), dtype=torch.float32),
        torch.tensor([0.2, 0.5, 0.7]),
    )
    found = []
    for draw in (drawing.draw_reference, drawing.draw_gsplat):
        scene, twists = tensors(small_room()), torch.zeros(2, 6, requires_grad=True)
        colours, alphas = draw(
            scene, CAMERA, drawing.apply_twists(Ts, twists), background, antialiased
        )
        found.append(
            (
                colours.detach(),
                alphas.detach(),
                torch.autograd.grad(colours.pow(2).sum(), [twists])[0],
            )
        )
    for first, second in zip(*found, strict=True):
        assert torch.allclose(first, second, rtol=1e-3, atol=1e-4)
    assert float(found[0][2].abs().max()) > 1.0


def test_photos_are_straightened_as_the_lens_bent_them(tmp_path):
    """A white spot where `Reconstruction.project` says that a bent lens shows a point.

    Without the bend it must be where the pinhole camera shows it. Bicubic sampling of a spot 3 px
    wide keeps its middle to a tenth of a pixel.
    """
    point, T = np.array([[1.1, -0.7, 2.0]]), np.eye(4)
    bent = Reconstruction(CAMERA, ("a.png",), tmp_path, T[None], k1=-0.12, aligned=True)
    u, v = bent.project(point, 0)[0]
    rows, columns = np.mgrid[:48, :64] + 0.5
    spot = 250.0 * np.exp(-0.5 * ((columns - u) ** 2 + (rows - v) ** 2) / 1.5**2)
    Image.fromarray(np.repeat(spot.round().astype(np.uint8)[..., None], 3, axis=2)).save(
        tmp_path / "a.png"
    )
    image = load_photos(bent).images[0, ..., 0].double().numpy()
    found = np.array([(image * columns).sum(), (image * rows).sum()]) / image.sum()
    expected = CAMERA.project(point, T)[0][0]
    assert np.abs(found - expected).max() < 0.1 and abs(u - expected[0]) > 1.0


def test_labels_follow_the_survey():
    """By hand, one Gaussian each: in the air, on the floor, below it, on the pad, on the marker."""
    corners = {
        "marker_corner_top_left": (0, 0.4, 1.15),
        "marker_corner_bottom_right": (0, -0.4, 0.35),
        "pad_near_left_top": (1.0, -1.0, 0.1),
        "pad_far_right_top": (14.0, -3.0, 0.1),
    }
    survey = Survey(tuple(corners), np.array(list(corners.values()), float), ("align",) * 4)
    places = [[3, 3, 2], [5, 4, 0.01], [5, 4, -2], [3, -2, 0.1], [0.02, 0.3, 0.8]]
    scene = GaussianScene(
        places, [[1, 0, 0, 0]] * 5, np.full((5, 3), 0.1), [0.5] * 5, np.zeros((5, 1, 3))
    )
    named = label_scene(scene, survey)
    assert [named.label_names[k] for k in named.labels] == [
        "rest",
        "floor",
        "floor",
        "pad",
        "marker",
    ]
    plain = label_scene(scene, None)
    assert [plain.label_names[k] for k in plain.labels] == [
        "rest",
        "floor",
        "floor",
        "rest",
        "rest",
    ]


def test_first_points_lie_in_the_room_and_take_the_colours_nearby():
    """Red points at one end and blue ones at the other: points added near the red end are red."""
    own = np.array([[-2.9, 0.0, 1.0], [2.9, 0.0, 1.0], [900.0, 0.0, 0.0]])
    colours = np.array([[255, 0, 0], [0, 0, 255], [0, 255, 0]], np.uint8)
    points, taken = initial_points(own, colours, ROOM, 400, 0)
    assert points.shape == taken.shape == (400, 3)
    assert (points >= ROOM[0]).all() and (points <= ROOM[1]).all()
    assert (taken[points[:, 0] < -0.1] == [255, 0, 0]).all() and (
        taken[points[:, 0] > 0.1] == [0, 0, 255]
    ).all()
    on_face = np.isclose(points, ROOM[0]) | np.isclose(points, ROOM[1])
    assert (
        0.84 < on_face.any(axis=1).mean() < 0.96
    )  # nine tenths, of 400: 0.015 is a standard deviation


# --- refusals ---


def test_photos_that_do_not_fit_are_named(taken, tmp_path):
    """Missing, damaged, another size, rotated: each has its own message with the photo's name."""
    for name in taken.names:
        (tmp_path / name).write_bytes((taken.folder / name).read_bytes())
    moved = replace(taken, folder=tmp_path)
    with pytest.raises(InputError, match=r"01.png: expected a photo, got a damaged"):
        (tmp_path / "01.png").write_bytes(b"\x89PNG nothing")
        load_photos(moved)
    Image.new("RGB", (32, 24)).save(tmp_path / "01.png")
    with pytest.raises(
        InputError,
        match=r"01.png: expected 64 x 48 px, got 32 x 24: the poses belong to another size",
    ):
        load_photos(moved)
    Image.new("RGB", (48, 64)).save(tmp_path / "01.png")
    with pytest.raises(InputError, match="it was rotated; rotate it back"):
        load_photos(moved)
    (tmp_path / "01.png").unlink()
    with pytest.raises(FileNotFoundError, match=r"01.png"):
        load_photos(moved)
    with pytest.raises(InputError, match="width: expected 16 to 64"):
        load_photos(taken, 200)


def test_a_reconstruction_that_is_not_aligned_is_refused(taken, tmp_path):
    """And nothing is written."""
    with pytest.raises(InputError, match="run: falconwing scene align"):
        fit_scene(replace(taken, aligned=False), tmp_path / "out")
    assert not (tmp_path / "out").exists()


def test_a_file_in_the_folders_place_is_left_alone(taken, tmp_path):
    """The text says so, and the file keeps its words."""
    (tmp_path / "notes").write_text("mine")
    with pytest.raises(InputError, match="expected a folder to write to, got a file"):
        fit_scene(taken, tmp_path / "notes", replace(SMALL, steps=1), say=lambda _: None)
    assert (tmp_path / "notes").read_text() == "mine"


def test_a_full_gpu_is_told_in_one_sentence(taken, tmp_path):
    """The renderer fails as torch does when memory runs out."""

    def full(*_):
        raise torch.cuda.OutOfMemoryError("CUDA out of memory")

    task = replace(task_of(taken, replace(SMALL, gaussians=100), tmp_path), draw=full)
    with pytest.raises(InputError, match=r"GPU memory: .* give a smaller --batch"):
        task.train()


@pytest.mark.parametrize(
    "changes, words",
    [
        ({"gaussians": 2}, "gaussians"),
        ({"hold_out": 0.9}, "hold_out"),
        ({"room": (0, 0, 0, 1, 1, -1)}, "room: expected"),
        ({"room": (1.0, 2.0)}, "room: expected"),
        ({"minutes": float("nan")}, "minutes"),
    ],
)
def test_settings_are_checked(changes, words):
    """Each has its name in the sentence."""
    with pytest.raises(InputError, match=words):
        FitSettings(**changes)


def test_the_verb_trains_and_judges(taken, tmp_path, capsys):
    """`falconwing scene fit`, then with --judge on its output: every held-out photo has a line."""
    write_reconstruction(tmp_path / "poses", taken)
    how = {
        "photos": taken.folder,
        "room": "-3,-2,0,3,2,2.5",
        "same_exposure": True,
        "pose_steps": 0,
    }
    verb = Fit(tmp_path / "poses", out=tmp_path / "out", gaussians=60, steps=3, **how)
    assert verb.run() == 0 and "held-out photos" in capsys.readouterr().out
    assert (
        Fit(tmp_path / "poses", judge=tmp_path / "out" / "scene.npz", json=True, **how).run() == 0
    )
    judged = json.loads(capsys.readouterr().out)
    assert {row["photo"] for row in judged["photos"]} <= set(taken.names) and judged[
        "psnr_worst_db"
    ] <= judged["psnr_db"]
    with pytest.raises(InputError, match="--out: expected a folder"):
        Fit(tmp_path / "poses").run()
    with pytest.raises(InputError, match="--room: expected six numbers"):
        Fit(tmp_path / "poses", out=tmp_path, room="wide").run()


def test_a_wrong_folder_is_one_line(tmp_path, capsys):
    """`falconwing scene fit` without a reconstruction: exit code 2 and one sentence."""
    assert main(["scene", "fit", str(tmp_path / "nowhere"), "--out", str(tmp_path / "out")]) == 2
    assert len(capsys.readouterr().err.splitlines()) == 1


def test_wandering_follows_the_shape_of_faint_gaussians():
    """A faint flat Gaussian moves within its plane, an opaque one stays (sigmoid of -100 x 0.9)."""
    from falconwing_kit.tools.capture.training.densify import add_noise

    state = initialise(np.eye(4, 3) * 5.0, np.zeros((4, 3), np.uint8), 1, 0, "cpu")
    state.values["log_scales"] = torch.tensor([[-1.0, -1.0, -8.0]] * 4)
    state.values["logits"] = torch.tensor([-5.3, -5.3, 2.2, 2.2])
    before = state.values["means"].clone()
    add_noise(state, 1e-3, 3.0, torch.Generator().manual_seed(1))
    off = (state.values["means"] - before).abs()
    assert off[:2, :2].min() > 1e-3 and off[:2, 2].max() < 1e-3 and off[2:].max() < 1e-6
    assert (
        covariances(state.values["quaternions"], state.values["log_scales"].exp())[0, 2, 2] < 1e-6
    )
