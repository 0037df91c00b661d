"""World alignment: planted similarities, drawn faces, path-traced photos against a tape measure."""

from dataclasses import replace

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from falconwing_kit.core.checks import InputError
from falconwing_kit.scene import PinholeCamera
from falconwing_kit.tools.capture.align import (
    Alignment,
    align,
    align_by_marker_poses,
    transform_reconstruction,
    triangulate,
    umeyama,
)
from falconwing_kit.tools.capture.photo_files import Reconstruction
from falconwing_kit.tools.capture.survey.faces import observe_faces
from falconwing_kit.tools.capture.survey.marker import observe_marker
from falconwing_kit.tools.capture.survey.picture import draw_alignment
from falconwing_kit.tools.capture.survey.points import (
    MARKER_CORNERS,
    PointObservations,
    Survey,
    read_clicks,
    read_survey,
)
from tests.scene import hall24

CAMERA = PinholeCamera(400.0, 400.0, 320.0, 240.0, 640, 480)
SCALE, TURN, MOVE = (
    2.5,
    Rotation.from_euler("xyz", (0.4, -1.1, 2.0)).as_matrix(),
    np.array([3.0, -7.0, 1.5]),
)
PAD = {"pad_near_left_top": (1, -1), "pad_near_right_top": (1, -3), "pad_far_left_top": (14, -1)}
PAD = {name: (*xy, 0.1) for name, xy in (PAD | {"pad_far_right_top": (14, -3)}).items()}
MARKER = dict(
    zip(
        MARKER_CORNERS,
        [(0, 0.4, 1.15), (0, -0.4, 1.15), (0, -0.4, 0.35), (0, 0.4, 0.35)],
        strict=True,
    )
)
SURVEY = Survey((*MARKER, *PAD), np.array([*MARKER.values(), *PAD.values()], float), ("align",) * 8)


def look_at(place, target):
    """T_world_camera of a level camera at a place that looks at a target."""
    forward = np.subtract(target, place) / np.linalg.norm(np.subtract(target, place))
    right = np.cross(forward, (0, 0, 1)) / np.linalg.norm(np.cross(forward, (0, 0, 1)))
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = np.stack([right, np.cross(forward, right), forward], axis=1), place
    return T


def photographed(rng, folder=".", count=12, k1=0.0):
    """A reconstruction with a planted similarity, and exact observations of marker and pad."""
    places = rng.uniform((-9, -5, 0.8), (-3, 3, 2.8), (count, 3))
    world = np.stack([look_at(place, (4.0, -1.0, 0.6)) for place in places])
    own = world.copy()
    own[:, :3, 3] = (world[:, :3, 3] - MOVE) @ TURN / SCALE
    own[:, :3, :3] = TURN.T @ world[:, :3, :3]
    made = Reconstruction(CAMERA, tuple(f"{k}.png" for k in range(count)), folder, own, k1=k1)
    truth = replace(made, T_world_camera=world, aligned=True)
    rows = [
        (name, k, truth.project(p[None], k)[0].tolist())
        for k in range(count)
        for name, p in zip(SURVEY.names, SURVEY.p_world, strict=True)
    ]
    return made, truth, PointObservations.join(rows)


def noisy(observations, rng, sigma_px):
    """Sightings with independent noise."""
    return replace(
        observations,
        pixels=observations.pixels + sigma_px * rng.standard_normal(observations.pixels.shape),
    )


@pytest.mark.parametrize("seed", range(6))
def test_umeyama_finds_a_planted_similarity(seed):
    """Its own inverse; also points in a plane, where a reflection would fit as well."""
    rng = np.random.default_rng(seed)
    R_planted = Rotation.random(random_state=seed).as_matrix()
    for points in (rng.standard_normal((6, 3)), rng.standard_normal((5, 3)) * (1, 1, 0)):
        scale, R, t = umeyama(points, SCALE * points @ R_planted.T + MOVE)
        assert scale == pytest.approx(SCALE, rel=1e-9)
        assert np.allclose(R, R_planted, atol=1e-9) and np.allclose(t, MOVE, atol=1e-9)


def test_points_in_a_line_are_refused():
    """Turns about the line are free then."""
    with pytest.raises(InputError, match="not in a line"):
        umeyama(np.outer(np.arange(4.0), (1, 2, 3)), np.outer(np.arange(4.0), (1, 2, 3)))


@pytest.mark.parametrize("k1", [0.0, -0.1])
def test_exact_sightings_give_the_planted_similarity(k1):
    """The triangulated points are those that were photographed, and so is the similarity.

    Lens bent or not.
    """
    made, truth, observations = photographed(np.random.default_rng(1), k1=k1)
    found = align(made, SURVEY, observations)
    for name, point in triangulate(made, observations).items():
        assert np.allclose(SCALE * TURN @ point + MOVE, SURVEY.places([name])[0], atol=1e-5)
    assert found.scale == pytest.approx(SCALE, rel=1e-6)
    assert np.allclose(
        transform_reconstruction(found, made).T_world_camera, truth.T_world_camera, atol=1e-5
    )


def test_wrong_sightings_do_not_pull():
    """A tenth of the sightings lie 60 px off.

    Without them the noise of 0.3 px leaves well under 5 cm.
    """
    rng = np.random.default_rng(2)
    made, truth, observations = photographed(rng)
    observations = noisy(observations, rng, 0.3)
    wrong = rng.random(len(observations)) < 0.1
    observations = replace(observations, pixels=observations.pixels + 60.0 * wrong[:, None])
    moved = (
        transform_reconstruction(align(made, SURVEY, observations), made).T_world_camera
        - truth.T_world_camera
    )
    assert wrong.sum() > 4 and np.abs(moved[:, :3, 3]).max() < 0.05


def test_stated_uncertainty_is_the_true_one():
    """Law: errors squared over stated variances average 1.

    Thirty draws tell it to about a quarter.
    """
    rng, ratios, far = np.random.default_rng(3), [], np.array([[-20.0, 5.0, 3.0]])
    for _ in range(30):
        made, _, observations = photographed(rng, count=24)
        tape = replace(
            SURVEY, p_world=SURVEY.p_world + 0.01 * rng.standard_normal(SURVEY.p_world.shape)
        )
        found = align(made, tape, noisy(observations, rng, 0.5))
        error = found.points((far - MOVE) @ TURN / SCALE) - far
        ratios.append(float((error**2).sum() / found.sigma(far)[0] ** 2))
    assert 0.5 < np.mean(ratios) < 1.6


def test_sigma_is_that_of_drawn_similarities():
    """Draws of scale, turn and move with a strong correlation, applied as such.

    3 % for turns of a degree.
    """
    rng = np.random.default_rng(9)
    spread = 0.01 * rng.standard_normal((7, 7))
    draws = rng.standard_normal((20000, 7)) @ spread.T
    p = np.array([4.0, -3.0, 2.0])
    turned = Rotation.from_rotvec(draws[:, 1:4]).apply(p - MOVE)
    moved = np.exp(draws[:, :1]) * turned + MOVE + draws[:, 4:]
    known = Alignment(SCALE, TURN, MOVE, "planted", spread @ spread.T).sigma(p[None])[0]
    assert known == pytest.approx(np.sqrt(((moved - p) ** 2).sum(axis=1).mean()), rel=0.03)


def test_pad_corners_make_the_hall_surer():
    """The marker is 0.8 m wide, the pad 13 m long: it reduces the uncertainty of the far hall."""
    rng = np.random.default_rng(4)
    made, _, observations = photographed(rng)
    observations = noisy(observations, rng, 0.4)
    only = np.array([name in MARKER for name in observations.names])
    chosen = tuple(name for name in observations.names if name in MARKER)
    marker = PointObservations(chosen, observations.photos[only], observations.pixels[only])
    far = np.array([[15.0, 5.0, 2.0], [-20.0, -10.0, 2.0]])
    assert (
        align(made, SURVEY, marker).sigma(far) > 3.0 * align(made, SURVEY, observations).sigma(far)
    ).all()


def test_single_view_marker_poses_fail_far_away():
    """The two-fold ambiguity of a small square: half a pixel of noise misplaces by metres."""
    rng = np.random.default_rng(5)
    made, truth, observations = photographed(rng)
    observations = noisy(observations, rng, 0.5)
    places = [
        transform_reconstruction(how(made, SURVEY, observations), made)
        for how in (align_by_marker_poses, align)
    ]
    baseline, good = (
        np.abs(p.T_world_camera - truth.T_world_camera)[:, :3, 3].max() for p in places
    )
    assert good < 0.1 and baseline > 3.0 * good


def test_baseline_is_right_where_it_can_be():
    """Without noise a square has one pose, so that the baseline's failing is not a slip of ours."""
    made, truth, observations = photographed(np.random.default_rng(6), k1=-0.05)
    found = transform_reconstruction(align_by_marker_poses(made, SURVEY, observations), made)
    assert np.allclose(found.T_world_camera, truth.T_world_camera, atol=1e-2)


def test_corners_of_a_drawn_face_are_found_to_a_part_of_a_pixel(tmp_path):
    """OpenCV draws the pad at eight times the size, area-averaged down, for exact edges."""
    made, truth, _ = photographed(np.random.default_rng(7), tmp_path, count=4)
    names = tuple(SURVEY.faces()[0])
    for k in range(len(made)):
        image = np.full((8 * 480, 8 * 640, 3), (60, 80, 100), np.uint8)
        corners = truth.project(SURVEY.places(names), k)
        cv2.fillPoly(
            image, [np.round(16 * (8 * corners - 0.5)).astype(np.int32)], (180, 60, 20), shift=4
        )
        small = cv2.resize(image, (640, 480), interpolation=cv2.INTER_AREA)
        cv2.imwrite(str(made.path(k)), small)
    rough = Alignment(
        SCALE, TURN, MOVE + np.array([0.02, -0.02, 0.01]), "planted, 3 cm off", 1e-4 * np.eye(7)
    )
    found = observe_faces(made, rough, [(names, SURVEY.places(names))])
    assert len(found) >= 8
    for name, photo, pixel in zip(found.names, found.photos, found.pixels, strict=True):
        assert np.linalg.norm(truth.project(SURVEY.places([name]), photo)[0] - pixel) < 0.35


def test_hall_photos_are_aligned_as_the_tape_says():
    """Unused corners of posters and windows, up to 19 m from the marker, measured by tape to 1 cm.

    24 photos from one end leave the far wall's depth open to some 0.2 m; a sign or frame error
    makes metres.
    """
    found, made, check = (
        hall24.alignments(),
        hall24.reconstruction(),
        hall24.survey().select("check"),
    )
    observations = observe_faces(
        made, found.best, [(names, check.places(names)) for names in check.faces()], plain=False
    )
    seen = triangulate(made, observations)
    names = [
        name for name in seen if observations.names.count(name) >= 6
    ]  # a few rays side by side tell no depth
    corners, tape = np.array([seen[name] for name in names]), check.places(names)
    miss = {
        recipe: np.linalg.norm(alignment.points(corners) - tape, axis=1)
        for recipe, alignment in (
            ("baseline", found.baseline),
            ("marker", found.marker),
            ("best", found.best),
        )
    }
    assert len(names) >= 6 and set(PAD) <= set(found.best.residuals)
    assert miss["marker"].max() < 0.4 and miss["best"].max() < 0.25
    assert miss["baseline"].mean() > 3.0 * miss["best"].mean()


def test_hall_cameras_stand_in_the_hall():
    """By the hall's README: x -22.5 to 17.5, y -12 to 8, z 0 to 5.

    These photos look along +x at the marker's front.
    """
    aligned = transform_reconstruction(hall24.alignments().best, hall24.reconstruction())
    places, ahead, down = (aligned.T_world_camera[:, :3, column] for column in (3, 2, 1))
    assert (places > (-22.5, -12, 0)).all() and (places < (17.5, 8, 5)).all()
    assert (ahead[:, 0] > 0).all() and (down[:, 2] < -0.5).all()


def test_aligned_photos_are_not_aligned_again():
    """Twice would scale twice."""
    found = hall24.alignments().best
    aligned = transform_reconstruction(found, hall24.reconstruction())
    for again in (
        lambda: transform_reconstruction(found, aligned),
        lambda: align(aligned, hall24.survey(), hall24.alignments().observations),
    ):
        with pytest.raises(InputError, match="not aligned yet"):
            again()


def test_another_marker_is_named():
    """The hall's marker is 7 of DICT_4X4_50."""
    few = hall24.reconstruction()
    few = replace(few, names=few.names[:4], T_world_camera=few.T_world_camera[:4])
    with pytest.raises(InputError, match="seen instead: marker 7 of it"):
        observe_marker(few, marker_id=9)
    with pytest.raises(InputError, match="seen instead: marker 7 of DICT_4X4_50"):
        observe_marker(few, dictionary="DICT_6X6_50")
    with pytest.raises(InputError, match="expected a name such as"):
        observe_marker(few, dictionary="DICT_3X3")


def test_survey_and_clicks_are_read_and_wrong_ones_refused(tmp_path):
    """One sentence each, with the line."""
    survey = read_survey(hall24.FOLDER / "survey.csv")
    assert survey.select("align").faces() == [
        ("pad_near_right_top", "pad_far_right_top", "pad_far_left_top", "pad_near_left_top")
    ]
    assert len(survey.select("check").faces()) == 7
    path = tmp_path / "file.csv"
    for text, words in (
        ("name,x,y,z\na,1,2,3\n", "use is missing"),
        ("name,x,y,z,use\na,1,2,up,align\n", "line 2: expected finite numbers"),
        ("name,x,y,z,use\na,1,2,3,look\n", "line 2: expected use align or check"),
        ("name,x,y,z,use\na,1,2,3,align\na,1,2,3,align\n", "each name once"),
        ("name,x,y,z,use\na,1,2\n", "line 2: expected 5 values"),
    ):
        path.write_text(text)
        with pytest.raises(InputError, match=words):
            read_survey(path)
    made, _, _ = photographed(np.random.default_rng(0))
    path.write_text(
        "name,photo,u,v\npad_near_left_top,3.png,10.5,20\npad_near_left_top,gone.png,1,2\n"
    )
    clicks = read_clicks(path, made, SURVEY)
    assert clicks.names == ("pad_near_left_top",) and clicks.photos.tolist() == [3]
    path.write_text("name,photo,u,v\nroof,3.png,10.5,20\n")
    with pytest.raises(InputError, match="line 2: expected a point of the survey, got 'roof'"):
        read_clicks(path, made, SURVEY)


def test_too_few_points_are_refused():
    """Two points leave a turn open."""
    made, _, observations = photographed(np.random.default_rng(8))
    two = [
        (n, int(k), uv.tolist())
        for n, k, uv in zip(
            observations.names, observations.photos, observations.pixels, strict=True
        )
    ]
    two = [row for row in two if row[0] in SURVEY.names[:2]]
    with pytest.raises(InputError, match="three surveyed points"):
        align(made, SURVEY, PointObservations.join(two))


def test_picture_is_drawn(tmp_path):
    """A PNG of some size; what it shows is for eyes."""
    found = hall24.alignments()
    shown = [("baseline", found.baseline), ("all points", found.best)]
    draw_alignment(tmp_path / "a.png", hall24.reconstruction(), hall24.survey(), shown)
    assert cv2.imread(str(tmp_path / "a.png")).shape[1] > 1000
