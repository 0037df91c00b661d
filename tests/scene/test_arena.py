"""The arena is a closed hall with pad, marker and leader in their places, and the marker can be
read off its images.
"""

import numpy as np
import pytest

from falconwing_kit.aircraft.airframe import default_airframe_path, load_airframe
from falconwing_kit.aircraft.touchdown import LandingPad
from falconwing_kit.core.checks import InputError
from falconwing_kit.core.frames import pose_matrix, rotation_world_body
from falconwing_kit.scene import GaussianScene, PinholeCamera, nose_camera_pose, render
from falconwing_kit.scene import arena as builder
from falconwing_kit.scene.arena import MARKER_ID, build_arena, leader_at, load_scene

CAMERA = PinholeCamera.from_fov_deg(
    640, 480, 77.8
)  # the lens of the hall's flights, 0.62 of the width
VIEWS = [  # x, y, z [m], roll, pitch, yaw [deg]
    (-20.0, -2.0, 1.5, 0.0, -3.0, 0.0),
    (-5.0, -1.0, 1.0, 5.0, 0.0, 20.0),
    (-12.0, 3.0, 2.5, -20.0, 25.0, 60.0),
    (10.0, -8.0, 1.2, 10.0, -25.0, 200.0),
    (3.0, 5.0, 3.0, 0.0, -60.0, -70.0),
]


@pytest.fixture(scope="module")
def arena():
    return build_arena()


@pytest.fixture(scope="module")
def hall(arena):
    return leader_at(arena, None)


def look(scene, pose, camera=CAMERA):
    """The frame that a camera at a pose in degrees sees."""
    return render(scene, camera, nose_camera_pose(pose[:3], *np.deg2rad(pose[3:])))


def test_same_seed_gives_the_same_bits(arena):
    """A law: nothing but the seed enters."""
    again = build_arena(0)
    for name in ("means", "quaternions", "scales", "opacities", "sh", "labels"):
        assert np.array_equal(getattr(arena, name), getattr(again, name))


def test_another_seed_changes_the_walls_and_leaves_pad_and_marker_in_place(arena):
    """The plan: only finishes marked `varies` and posters change; a hue turned by 0.15 or more is
    no rounding.
    """
    other = build_arena(1)
    for label in ("pad", "marker", "leader", "floor"):
        mine, yours = (scene.selected(scene.labelled(label)) for scene in (arena, other))
        assert np.array_equal(mine.means, yours.means)
    walls = [scene.sh[scene.labelled("wall"), 0].mean(axis=0) for scene in (arena, other)]
    assert np.abs(walls[0] - walls[1]).max() > 0.1


@pytest.mark.parametrize(
    ("pose", "distance"),
    [
        ((-3.0, 4.0, 1.0, 0.0, 0.0, 0.0), 20.5),  # far wall
        ((-3.0, 4.0, 1.0, 0.0, 0.0, 180.0), 19.5),  # near wall
        ((-3.0, 4.0, 1.0, 0.0, 0.0, -90.0), 4.0),  # left wall at y = 8
        ((-3.0, 4.0, 1.0, 0.0, 0.0, 90.0), 16.0),  # right wall at y = -12
        ((-2.0, 4.0, 1.0, 0.0, 90.0, 0.0), 4.0),  # ceiling
        ((-2.0, 4.0, 1.0, 0.0, -90.0, 0.0), 1.0),  # floor
    ],
)
def test_walls_stand_where_the_design_says(hall, pose, distance):
    """DESIGN, section 3: 40 x 20 x 5 m, x from -22.5, y from -12. 2 %: what shows through gaps lies
    a metre behind.
    """
    depth = look(hall, pose).depth[230:250, 310:330]
    assert np.median(depth) == pytest.approx(distance, rel=0.02, abs=0.03)


@pytest.mark.parametrize("pose", VIEWS)
def test_no_view_has_a_hole(hall, pose):
    """A closed hall covers every pixel; 2 % are left for the last gaps, which no eye sees."""
    assert look(hall, pose).alpha.min() > 0.98


def test_pad_lies_where_aircraft_land(arena):
    """The place is that of `LandingPad`, by which touchdowns are judged; surfels end within 2 cm of
    the border.
    """
    pad, means = LandingPad(), arena.means[arena.labelled("pad")]
    low = [pad.x_start, pad.y_centre - pad.width / 2, 0.0]
    high = [pad.x_start + pad.length, pad.y_centre + pad.width / 2, pad.height]
    np.testing.assert_allclose(means.min(axis=0), low, atol=0.02)
    np.testing.assert_allclose(means.max(axis=0), high, atol=0.02)


def test_pad_is_blue_where_the_geometry_says(hall):
    """Points on the pad's top and beside it: blue leads red by far on the pad alone."""
    pose = (-8.0, -2.0, 1.5, 0.0, -5.0, 0.0)
    rgb = look(hall, pose).rgb
    points = np.array(
        [[x, y, 0.1] for x in (3.3, 7.4, 11.6) for y in (-2.7, -2.0, -1.3, 0.5, -4.5)]
    )
    pixels, _ = CAMERA.project(points, nose_camera_pose(pose[:3], *np.deg2rad(pose[3:])))
    red, _, blue = rgb[pixels[:, 1].astype(int), pixels[:, 0].astype(int)].T
    on_pad = np.abs(points[:, 1] + 2.0) < 1.0
    assert np.all((blue - red > 0.3) == on_pad)


def test_court_line_is_straight_and_in_its_place(hall):
    """The plan: a white line at x = -2.5 from y = -9.5 to 5.5; all along it outshines the wood 15
    cm beside it.
    """
    pose = (-4.5, -2.0, 2.5, 0.0, -50.0, 0.0)
    grey = look(hall, pose).rgb.mean(axis=2)
    y = np.arange(-3.5, -0.4, 0.25)
    line, beside = (
        CAMERA.project(
            np.column_stack([np.full(len(y), x), y, 0 * y]),
            nose_camera_pose(pose[:3], *np.deg2rad(pose[3:])),
        )[0].astype(int)
        for x in (-2.5, -2.65)
    )
    assert np.all(grey[line[:, 1], line[:, 0]] > grey[beside[:, 1], beside[:, 0]] + 0.1)


@pytest.mark.parametrize("yaw_deg", [-120.0, -90.0, -60.0])
def test_a_beam_overhead_does_not_veil_what_is_ahead(hall, yaw_deg):
    """Geometry: 0.45 m below the beam at x = 0 and level, what is 5 to 25 deg below the horizon is
    the wall at y = -12.

    By hand, a pixel's ray meets that wall at the depth 7.5 m / (-v), v the ray's part along the
    wall's normal for one metre ahead; between the wall bars and the pipe nothing stands before it.
    A large piece close to the camera once spread over half the image, as the local affine
    projection of Gaussians allows.
    """
    T_world_camera = nose_camera_pose((-0.5, -4.5, 4.2), 0.0, 0.0, np.deg2rad(-yaw_deg))
    depth = render(hall, CAMERA, T_world_camera).depth
    u, v = np.meshgrid(np.arange(40, 600, 15), np.arange(260, 420, 8))
    rays = np.stack(
        [(u + 0.5 - CAMERA.cx) / CAMERA.fx, (v + 0.5 - CAMERA.cy) / CAMERA.fy, np.ones(u.shape)],
        axis=-1,
    )
    along_y = (rays @ T_world_camera[:3, :3].T)[..., 1]
    wall = 7.5 / -along_y
    x, z = (
        start + wall * (rays @ T_world_camera[:3, :3].T)[..., i]
        for i, start in ((0, -0.5), (2, 4.2))
    )
    meets = (along_y < -0.2) & (abs(x) < 12.0) & (z > 2.7) & (z < 3.7)
    assert meets.sum() > 40
    assert np.all(depth[v, u][meets] > 0.9 * wall[meets])


@pytest.mark.parametrize("distance", [3.0, 5.0, 7.0, 10.0])
@pytest.mark.parametrize("side", [-0.4, 0.0, 0.3])
def test_marker_is_found_and_its_pose_is_right(hall, distance, side):
    """OpenCV's detector and solvePnP against the pose that was asked for: 5 % of the distance, the
    bound.

    A square that faces the camera looks the same tilted a little either way: its attitude enters
        the image in second
    order only. So straight ahead the angle is asked for up to 5 m, from the side up to 10 m (32
    pixels wide).
    """
    import cv2

    p_world = np.array([-distance * np.cos(side), distance * np.sin(side), 1.2])
    T_world_camera = nose_camera_pose(p_world, 0.1, -0.03, side + 0.1)
    grey = cv2.cvtColor(
        (255.0 * render(hall, CAMERA, T_world_camera).rgb).astype(np.uint8), cv2.COLOR_RGB2GRAY
    )
    settings = cv2.aruco.DetectorParameters()
    settings.cornerRefinementMethod = cv2.aruco.CORNER_REFINE_SUBPIX
    dictionary = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_4X4_50)
    corners, ids, _ = cv2.aruco.ArucoDetector(dictionary, settings).detectMarkers(grey)
    assert ids is not None and ids.ravel().tolist() == [MARKER_ID]
    square = 0.4 * np.array(
        [[-1.0, 1.0, 0.0], [1.0, 1.0, 0.0], [1.0, -1.0, 0.0], [-1.0, -1.0, 0.0]]
    )
    image = (
        corners[0].reshape(4, 2).astype(float) + 0.5
    )  # OpenCV counts from the first pixel's centre
    _, turn, p_camera = cv2.solvePnP(square, image, CAMERA.K, None, flags=cv2.SOLVEPNP_IPPE_SQUARE)
    expected = (np.array([0.0, 0.0, 0.75]) - p_world) @ T_world_camera[:3, :3]
    assert np.linalg.norm(p_camera.ravel() - expected) < 0.05 * np.linalg.norm(expected)
    if distance <= 5.0 or side != 0.0:
        R_world_marker = np.array(
            [[0.0, 0.0, -1.0], [-1.0, 0.0, 0.0], [0.0, 1.0, 0.0]]
        )  # x right, y up, z to us
        wrong = cv2.Rodrigues(turn)[0] @ (T_world_camera[:3, :3].T @ R_world_marker).T
        assert np.degrees(np.arccos((np.trace(wrong) - 1.0) / 2.0)) < 5.0


def test_leader_has_the_size_of_the_aircraft(arena):
    """The airframe file: span 0.70 m, tyres 0.11 m below the centre of gravity; a surfel's centre
    is within 1 cm.
    """
    airframe = load_airframe(default_airframe_path())
    means = arena.means[arena.labelled("leader")]
    assert np.ptp(means[:, 1]) == pytest.approx(0.70, abs=0.01)
    assert np.ptp(means[:, 0]) == pytest.approx(0.52, abs=0.03)
    assert means[:, 2].max() == pytest.approx(airframe.wheels.points_body[:, 2].max(), abs=0.01)


def test_leader_flies_nose_ahead_and_fin_up(arena):
    """Body axes by hand: the red nose at +x, the blue fin behind and above, at -x and -z."""
    leader = arena.selected(arena.labelled("leader"))
    red, _, blue = (0.5 + 0.2820948 * leader.sh[:, 0]).T
    x, y, z = leader.means.T
    nose = (red > 2 * blue) & (np.abs(y) < 0.04) & (np.abs(x) > 0.1)
    assert nose.sum() > 50 and x[nose].min() > 0.1
    fin = (blue > 2 * red) & (np.abs(y) < 0.04)
    assert fin.sum() > 50 and x[fin].max() < -0.2 and z[fin].mean() < -0.03


def test_leader_is_seen_where_it_is_placed(arena, hall):
    """Pinhole by hand: 4 m ahead and 0.5 m to the right it is at u = 320 + 0.62 * 640 * 0.5 / 4 =
    370.
    """
    pose = (-10.0, -2.0, 1.5, 0.0, 0.0, 0.0)
    T_world_leader = pose_matrix(np.diag([1.0, -1.0, -1.0]), np.array([-6.0, -2.5, 1.5]))
    changed = (
        np.abs(look(leader_at(arena, T_world_leader), pose).rgb - look(hall, pose).rgb).max(axis=2)
        > 0.1
    )
    rows, columns = np.nonzero(changed)
    assert columns.mean() == pytest.approx(370, abs=4) and rows.mean() == pytest.approx(240, abs=8)
    assert np.ptp(columns) == pytest.approx(0.62 * 640 * 0.70 / 4.0, rel=0.15)


def test_moving_leader_and_camera_together_leaves_the_image(arena):
    """A law of rigid motion, for colours up to degree 3; 2 of 255 steps for 32-bit rounding at
    cut-offs.
    """
    rng = np.random.default_rng(5)
    leader = arena.selected(arena.labelled("leader"))
    sh = np.concatenate([leader.sh, rng.normal(size=(len(leader), 15, 3)) * 0.2], axis=1)
    leader = GaussianScene(
        leader.means, leader.quaternions, leader.scales, leader.opacities, sh, (), ("leader",)
    )
    T_leader_camera = nose_camera_pose((-1.0, 0.2, 0.1), 0.2, 0.1, 0.15)
    T_world_leader = pose_matrix(rotation_world_body(0.7, -0.4, 2.1), np.array([3.0, -1.0, 2.0]))
    camera = PinholeCamera.from_fov_deg(120, 90, 60.0)
    before = render(leader, camera, T_leader_camera)
    after = render(leader_at(leader, T_world_leader), camera, T_world_leader @ T_leader_camera)
    assert before.alpha.max() > 0.9
    np.testing.assert_allclose(after.rgb, before.rgb, atol=2 / 255)
    np.testing.assert_allclose(after.alpha, before.alpha, atol=2 / 255)


def test_colour_of_degree_one_turns_by_hand(arena):
    """By hand: Y_1 = (-y, z, -x); turned 90 deg from x to y, what faced x faces y: c1' = c3, c3' =
    -c1.
    """
    leader = arena.selected(arena.labelled("leader"))
    sh = np.zeros((len(leader), 4, 3))
    sh[:, 1], sh[:, 2], sh[:, 3] = 0.1, 0.2, 0.3
    leader = GaussianScene(
        leader.means, leader.quaternions, leader.scales, leader.opacities, sh, (), ("leader",)
    )
    turn = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    turned = leader_at(leader, pose_matrix(turn, np.zeros(3))).sh
    np.testing.assert_allclose(turned[0, 1:, 0], [0.3, 0.2, -0.1], atol=1e-6)


@pytest.mark.parametrize(
    "pose", [np.eye(3), np.diag([1.0, 1.0, -1.0, 1.0]), np.full((4, 4), np.nan), 2.0 * np.eye(4)]
)
def test_a_pose_that_is_none_is_refused(arena, pose):
    """Wrong shape, mirrored, not finite, stretched."""
    with pytest.raises(InputError, match="T_world_body"):
        leader_at(arena, pose)


def test_a_scene_without_leader_is_refused(hall):
    """The text lists the labels."""
    plain = GaussianScene(
        hall.means[:9], hall.quaternions[:9], hall.scales[:9], hall.opacities[:9], hall.sh[:9]
    )
    with pytest.raises(InputError, match="leader"):
        leader_at(plain, np.eye(4))


@pytest.mark.parametrize("seed", [-1, 1.5, "0", None, True])
def test_a_seed_that_is_none_is_refused(seed):
    """A seed is a whole number from 0 on."""
    with pytest.raises(InputError, match="seed"):
        build_arena(seed)


def test_unknown_name_is_refused_with_the_known_ones():
    """The names are those of DESIGN, section 5, as far as they ship."""
    with pytest.raises(InputError, match="arena, hall, hall_analog, leader"):
        load_scene("stadium")


@pytest.fixture
def builds(arena, monkeypatch, tmp_path):
    """How often the arena is built; its cache is an empty folder."""
    calls = []
    small = arena.selected(arena.labelled("leader", "marker"))
    monkeypatch.setattr(builder, "build_arena", lambda: calls.append(1) or small)
    monkeypatch.setattr(builder, "cache_folder", lambda: tmp_path / "deep" / "cache")
    return calls


def test_arena_is_built_once_and_then_read(builds, tmp_path):
    """The second call finds the file that the first one wrote, and reads the same bits."""
    first, second = load_scene("arena"), load_scene("arena")
    assert (
        len(builds) == 1
        and np.array_equal(first.means, second.means)
        and np.array_equal(first.sh, second.sh)
    )
    assert len(list((tmp_path / "deep" / "cache").iterdir())) == 1


def test_only_the_newest_arena_is_kept(builds, tmp_path):
    """Ten megabytes of each version would add up: the file of another builder goes, what is no
    arena stays.
    """
    folder = tmp_path / "deep" / "cache"
    folder.mkdir(parents=True)
    for name in ("arena-0123456789ab.npz", "arena-ba9876543210.npz", "notes.txt"):
        (folder / name).write_text("of another builder")
    load_scene("arena")
    kept = {path.name for path in folder.iterdir()}
    assert (
        len(kept) == 2
        and "notes.txt" in kept
        and not kept & {"arena-0123456789ab.npz", "arena-ba9876543210.npz"}
    )
    load_scene("arena")
    assert len(builds) == 1  # its own file is the one that stayed


def test_leader_comes_alone(builds):
    """The same file gives the leader by its label."""
    leader = load_scene("leader")
    assert leader.labelled("leader").all() and np.abs(leader.means).max() < 0.4


def test_damaged_cache_is_built_anew(builds, tmp_path):
    """Half a file is no scene."""
    load_scene("arena")
    (path,) = (tmp_path / "deep" / "cache").iterdir()
    path.write_bytes(path.read_bytes()[:1000])
    load_scene("arena")
    assert len(builds) == 2 and len(GaussianScene.load(path)) > 1000


def test_cache_that_cannot_be_written_is_no_reason_to_stop(builds, tmp_path):
    """A file stands where the folder should be."""
    (tmp_path / "deep").write_text("in the way")
    assert len(load_scene("arena")) == len(load_scene("arena")) and len(builds) == 2
