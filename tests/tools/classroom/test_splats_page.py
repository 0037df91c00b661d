"""The page's renderer in headless Chromium without a GPU: pictures against `render`, cameras
against core/frames.py, boxes against the projection of their corners.
"""

import gzip
import re

import numpy as np
import pytest
from scipy.spatial.transform import Rotation, Slerp

from falconwing_kit.core.frames import (
    HALL_HIGH,
    HALL_LOW,
    camera_pose,
    pose_matrix,
    rotation_world_body,
)
from falconwing_kit.scene import (
    GaussianScene,
    PinholeCamera,
    leader_at,
    load_scene,
    nose_camera_pose,
    render,
    require_pose,
)
from falconwing_kit.tools.capture.packed_write import spz_bytes
from falconwing_kit.tools.classroom.aircraft_boxes import AIRCRAFT
from falconwing_kit.tools.classroom.scene_file import scene_bytes
from tests.tools.classroom.splat_page import PAGE, splat_page

pytestmark = pytest.mark.timeout(300)
WIDTH, HEIGHT, FOV_DEG = 240, 180, 77.8
CAMERA = PinholeCamera.from_fov_deg(WIDTH, HEIGHT, FOV_DEG)
# Position [m] and roll, pitch, yaw [rad]: along the approach, over the pad, turned, banked, high
POSES = (
    (-19.0, 0.0, 1.5, 0.1, -0.05, 0.0),
    (-14.0, 1.0, 1.2, -0.3, 0.0, 0.2),
    (-10.0, 0.3, 1.5, 0.1, -0.05, 0.1),
    (-6.0, -2.0, 1.0, 0.0, 0.1, -0.2),
    (-3.5, -2.0, 0.5, 0.05, 0.0, 0.0),
    (0.5, -2.0, 0.2, 0.0, 0.05, 0.0),
    (5.0, 3.0, 2.5, 0.4, -0.2, 2.5),
    (10.0, -8.0, 3.0, -0.1, -0.3, -2.0),
    (-12.0, 6.0, 4.0, 0.6, -0.4, 1.0),
    (15.0, 0.0, 1.0, 0.0, 0.0, 3.1),
)
HALL_POSES = (POSES[2], POSES[6])
# The page's pictures differ from `render` by the rounding of the file and of 8 bits a channel,
# some 45 to 54 dB. 38 leaves room for a driver; a picture upside down or of another pose has
# less than 20.
MIN_PSNR = 38.0
FLOOR_AT = np.eye(4)
RED, GREY = (0.8, 0.2, 0.1), (0.4, 0.5, 0.6)


def surfel(mean, deviations, rgb, opacity=0.999):
    """One Gaussian with its axes along the world's."""
    sh = (np.array([[rgb]]) - 0.5) / 0.28209479
    return GaussianScene([mean], [[1, 0, 0, 0]], [deviations], [opacity], sh)


def harmonic_ball():
    """A large ball, bluer from the front, of degree 2; the page draws its degree 1."""
    sh = np.zeros((1, 9, 3))
    sh[0, 0] = (np.array(GREY) - 0.5) / 0.28209479
    sh[0, 1:4] = [[0.1, -0.2, 0.3], [0.25, 0.1, -0.1], [-0.3, 0.2, -0.4]]
    return GaussianScene([[3, 0, 1]], [[1, 0, 0, 0]], [[1, 1, 1]], [0.999], sh)


@pytest.fixture(scope="module")
def scenes():
    """Scenes by the names that the page asks for."""
    wall, floor = surfel((3, 0, 1), (0.01, 4, 4), RED), surfel((0.8, 0, 0), (2, 2, 0.002), GREY)
    return {
        "arena": leader_at(load_scene("arena"), None),
        "hall": load_scene("hall"),
        "wall": wall,
        "floor": floor,
        "ball": harmonic_ball(),
        "far": surfel((-50, 0, 1), (0.1, 0.1, 0.1), RED),
    }


@pytest.fixture(scope="module")
def shown(scenes):
    """The page, with every scene at its name; the arena as gzip, as in a page of one file."""
    files = {name: scene_bytes(scene) for name, scene in scenes.items() if name != "ball"}
    files["arena"] = gzip.compress(files["arena"], 1)
    files["ball"] = spz_bytes(scenes["ball"])[0]
    files["text"], files["cut"] = b"no scene at all, but some words", files["wall"][:-1]
    with splat_page(files, WIDTH, HEIGHT) as page:
        yield page


def psnr(image, expected):
    """Peak signal-to-noise ratio of two images in 0..1 [dB]."""
    return -10.0 * np.log10(np.mean((np.asarray(image) - expected) ** 2))


def nose(pose):
    """T_world_camera from six numbers."""
    return nose_camera_pose(pose[:3], *pose[3:])


@pytest.mark.parametrize(("name", "poses"), [("arena", POSES), ("hall", HALL_POSES)])
def test_pictures_equal_those_of_render(shown, scenes, name, poses):
    """The same Gaussians at the same poses by another implementation, scene/fast.py."""
    assert shown.open_view(name) == len(scenes[name])
    for pose in poses:
        expected = render(scenes[name], CAMERA, nose(pose), backend="fast").rgb
        assert psnr(shown.picture(nose(pose), FOV_DEG), expected) > MIN_PSNR, pose
        assert psnr(expected[::-1], expected) < 20.0  # the measure sees a picture upside down


def test_background_colours_and_harmonics_are_those_of_render(shown, scenes):
    """One ball that changes its colour with the direction, over grey, from two sides: 2 levels."""
    background = (0.25, 0.5, 0.75)
    shown.open_view("ball", background=background)
    flat = scenes["ball"]
    degree_1 = GaussianScene(
        flat.means, flat.quaternions, flat.scales, flat.opacities, flat.sh[:, :4]
    )
    for pose in ((0, 0, 1, 0, 0, 0), (2, 2.5, 2, 0.3, -0.2, 1.2)):
        expected = render(degree_1, CAMERA, nose(pose), background=background).rgb
        assert np.abs(shown.picture(nose(pose), FOV_DEG) - expected).max() < 2.6 / 255.0
        assert np.ptp(expected) > 0.2


def set_aircraft(shown, *aircraft):
    """Aircraft as (pose matrix, colour, opacity)."""
    keys = ("T_world_body", "color", "opacity")
    rows = [
        dict(zip(keys, (np.ravel(T).tolist(), color, opacity), strict=True))
        for T, color, opacity in aircraft
    ]
    shown.page.evaluate("list => view.setAircraft(list)", rows)


def at(x, y, z, roll=0.0, pitch=0.0, yaw=0.0):
    """T_world_body."""
    return pose_matrix(rotation_world_body(roll, pitch, yaw), (x, y, z))


def test_boxes_are_where_their_corners_are_projected(shown):
    """The outline of the pixels drawn equals that of all corners, by PinholeCamera.project: to the
    pixel, for a banked aircraft seen from the side and above.
    """
    shown.open_view("far")
    T_world_body = at(2.0, -0.3, 1.1, 0.5, 0.2, 0.9)
    camera = nose((0.0, 0.0, 1.4, 0.1, -0.1, 0.05))
    set_aircraft(shown, (T_world_body, None, 1))
    rows, columns = np.nonzero(shown.picture(camera, FOV_DEG).sum(axis=2))
    signs = np.array(np.meshgrid(*[(-0.5, 0.5)] * 3)).reshape(3, -1).T
    corners = np.concatenate([np.array(c) + signs * s for _, s, c in AIRCRAFT])
    pixels, _ = CAMERA.project(corners @ T_world_body[:3, :3].T + T_world_body[:3, 3], camera)
    drawn = np.array([columns.min(), rows.min(), columns.max() + 1, rows.max() + 1])
    expected = np.concatenate([pixels.min(axis=0), pixels.max(axis=0)])
    assert np.abs(drawn - expected).max() <= 1.0
    assert np.ptp(expected[::2]) > 40.0


def test_boxes_hide_what_is_behind_them_and_are_hidden(shown):
    """A red wall at x = 3: an aircraft at 2 m is seen in full before it, one at 4 m not at all."""
    camera = nose((0.0, 0.0, 1.0, 0.0, 0.0, 0.0))
    shown.open_view("far")
    set_aircraft(shown, (at(2, 0, 1), None, 1))
    alone = shown.picture(camera, FOV_DEG)
    shown.open_view("wall")
    wall = shown.picture(camera, FOV_DEG)
    set_aircraft(shown, (at(2, 0, 1), None, 1))
    before = shown.picture(camera, FOV_DEG)
    set_aircraft(shown, (at(4, 0, 1), None, 1))
    behind = shown.picture(camera, FOV_DEG)
    covered = alone.sum(axis=2) > 0.0
    assert covered.sum() > 100
    assert np.abs(before - np.where(covered[..., None], alone, wall)).max() < 1.5 / 255.0
    hidden = np.abs(behind - wall)[60:120, 90:150]  # 0.1 % shine through an opacity of 0.999
    assert hidden.max() < 10.0 / 255.0


def test_a_floor_passes_under_the_wheels(shown):
    """One wide Gaussian whose middle lies 1.2 m nearer than the aircraft on it: its mean is before
    the aircraft, its surface is not.
    """
    camera = nose((0.0, 0.0, 1.0, 0.0, -0.3, 0.0))
    aircraft = (at(2.0, 0.0, 0.15), None, 1)
    shown.open_view("far")
    set_aircraft(shown, aircraft)
    alone = shown.picture(camera, FOV_DEG)
    shown.open_view("floor")
    floor = shown.picture(camera, FOV_DEG)
    set_aircraft(shown, aircraft)
    covered = (alone.sum(axis=2) > 0.0)[..., None]
    assert np.abs(shown.picture(camera, FOV_DEG) - np.where(covered, alone, floor)).max() < 0.01
    assert floor[covered[..., 0]].min() > 0.05  # there is floor behind every pixel of it


def test_a_ghost_is_the_mean_of_itself_and_what_is_behind(shown):
    """Opacity 1/2: half the solid aircraft of that colour and half the wall, with no inner face."""
    camera = nose((0.0, 0.0, 1.2, 0.0, -0.05, 0.0))
    shown.open_view("wall")
    wall = shown.picture(camera, FOV_DEG)
    ghost = at(2, 0.1, 1, 0.3, 0.1, 0.4)
    pictures = []
    for opacity in (1, 0.5):
        set_aircraft(shown, (ghost, "#3070f0", opacity))
        pictures.append(shown.picture(camera, FOV_DEG))
    solid, translucent = pictures
    assert np.abs(translucent - 0.5 * (solid + wall)).max() < 1.5 / 255.0
    assert np.abs(solid - wall).max() > 0.3


def test_python_and_the_page_have_the_same_boxes(shown):
    """Number by number."""
    boxes = shown.page.evaluate("aircraft.AIRCRAFT_BOXES")
    assert boxes == [[list(colour), list(size), list(centre)] for colour, size, centre in AIRCRAFT]


def matrices(shown, function, *rows):
    """Results of a function of camera.js, (N, 4, 4)."""
    call = f"rows => rows.map(row => Array.from(camera.{function}(...row)))"
    return np.reshape(shown.page.evaluate(call, list(rows)), (-1, 4, 4))


def test_poses_and_nose_cameras_are_those_of_frames(shown):
    """Random attitudes and mounts, to 12 digits; a pitched mount is a pitched body at its place."""
    rng = np.random.default_rng(3)
    poses = rng.uniform(-1.5, 1.5, (20, 6))
    bodies = pose_matrix(rotation_world_body(*poses.T[3:]), poses[:, :3])
    assert np.allclose(matrices(shown, "poseMatrix", *poses.tolist()), bodies, atol=1e-12)
    mounts = rng.uniform(-0.3, 0.3, (20, 3))
    expected = [camera_pose(*pair) for pair in zip(bodies, mounts, strict=True)]
    pairs = [[pose.tolist(), m.tolist()] for pose, m in zip(poses, mounts, strict=True)]
    assert np.allclose(matrices(shown, "noseCamera", *pairs), expected, atol=1e-12)
    mount = {"p_body_camera": [0.2, 0, 0.05], "pitch_deg": 20.0}
    T_body_pitched = np.diag([1.0, -1.0, -1.0, 1.0]) @ at(0, 0, 0, 0, np.radians(20.0), 0)
    T_body_pitched[:3, 3] = mount["p_body_camera"]
    (pitched,) = matrices(shown, "noseCamera", [bodies[0].ravel().tolist(), mount])
    assert np.allclose(pitched, camera_pose(bodies[0] @ T_body_pitched), atol=1e-12)


def test_interpolated_poses_are_those_of_scipy(shown):
    """Slerp of scipy, from one random attitude to another, half turns included; ends exactly."""
    rng = np.random.default_rng(4)
    a, b = rng.uniform(-3.0, 3.0, (2, 30, 6))
    shares = np.concatenate([[0.0, 1.0], rng.uniform(0.0, 1.0, 28)])
    rows = [[p.tolist(), q.tolist(), s] for p, q, s in zip(a, b, shares, strict=True)]
    got = matrices(shown, "interpolatePoses", *rows)
    for T, p, q, s in zip(got, a, b, shares, strict=True):
        ends = Rotation.from_matrix([rotation_world_body(*x[3:]) for x in (p, q)])
        assert np.allclose(T[:3, :3], Slerp([0.0, 1.0], ends)(s).as_matrix(), atol=1e-9)
        assert np.allclose(T[:3, 3], (1.0 - s) * p[:3] + s * q[:3], atol=1e-12)


def test_chase_and_tower_cameras_look_at_the_aircraft_level(shown):
    """Laws: rigid; the right edge of the image is level and its lower edge is down; the tower has
    the aircraft in the middle; the chase camera is behind it and inside the hall; nose up at 90
    degrees is no exception.
    """
    rng = np.random.default_rng(5)
    poses = rng.uniform((-22, -11, 0.1, -1, -1, -3), (17, 7, 4.5, 1, 1, 3), (20, 6))
    poses[0, 3:] = 0.0, np.pi / 2.0, 0.0
    bounds = dict(zip("xyz", np.transpose([HALL_LOW, HALL_HIGH]).tolist(), strict=True))
    chase = matrices(shown, "chaseCamera", *([p.tolist(), {"hall": bounds}] for p in poses))
    tower = matrices(shown, "towerCamera", *([p.tolist(), [-6, 6.5, 3.2]] for p in poses))
    for T in (*chase, *tower):
        require_pose("T_world_camera", T)
        assert abs(T[2, 0]) < 1e-12 and T[2, 1] <= 0.0
    for T, pose in zip(tower, poses, strict=True):
        pixel, depth = CAMERA.project(pose[None, :3], T)
        assert np.allclose(pixel, [[WIDTH / 2.0, HEIGHT / 2.0]], atol=1e-6) and depth[0] > 0.0
    places = chase[:, :3, 3]
    assert (places > HALL_LOW).all() and (places < HALL_HIGH).all()
    level = [-3.0, 0.0, 1.0, 0.4, 0.2, 0.5]
    (T,) = matrices(shown, "chaseCamera", [level, {"hall": bounds}])
    course = rotation_world_body(0.0, 0.0, 0.5)[:, 0]
    assert (T[:3, 3] - level[:3]) @ course < -2.0 and np.allclose(
        T[:2, 2] / np.hypot(*T[:2, 2]), course[:2], atol=1e-9
    )


def test_a_lost_context_is_reported_and_drawn_again(shown):
    """By the browser's own extension for it; the picture afterwards equals the one before."""
    shown.open_view("wall")
    set_aircraft(shown, (at(2, 0, 1), None, 1))
    camera = nose((0.0, 0.0, 1.0, 0.0, 0.0, 0.0))
    before = shown.picture(camera, FOV_DEG)
    shown.page.evaluate(
        "() => { said.length = 0; window.lose = view.gl.getExtension('WEBGL_lose_context');"
        " lose.loseContext(); }"
    )
    shown.page.wait_for_function("said.length === 1")
    shown.page.evaluate("T => view.draw(T)", camera.ravel().tolist())  # nothing, and no exception
    assert not shown.page.evaluate("view.ready")
    shown.page.evaluate("lose.restoreContext()")
    shown.page.wait_for_function("said.length === 2")
    first, second = shown.page.evaluate("said")
    assert "graphics" in first and second == ""
    assert np.array_equal(shown.picture(camera, FOV_DEG), before)


@pytest.mark.parametrize("ends", ["lost", "disposed"])
def test_a_frame_that_is_being_drawn_when_the_view_ends_does_no_harm(shown, ends):
    """The graphics go, or the view does, with a frame under way: no complaint, and graphics that
    come back show the last view that was asked for, at y = 0.3 m.
    """
    shown.open_view("wall", keep=False)
    poses = [nose((0.0, y, 1.0, 0.0, 0.0, 0.0)).ravel().tolist() for y in (0.0, 0.3)]
    shown.page.evaluate(
        """([T, end]) => {
          globalThis.complaints = [];
          addEventListener("error", (event) => complaints.push(event.message));
          said.length = 0;
          globalThis.lose = view.gl.getExtension("WEBGL_lose_context");
          view.draw(T);
          if (!view.frame) complaints.push("no frame is being drawn");
          if (end === "lost") lose.loseContext();
          else view.dispose();
          view.draw(T);
        }""",
        [poses[0], ends],
    )
    if ends == "lost":
        shown.page.wait_for_function("said.length === 1")
        shown.page.evaluate("T => view.draw(T)", poses[1])
        shown.page.evaluate("lose.restoreContext()")
        shown.page.wait_for_function("said.length === 2 && view.shown !== '' && !view.frame")
        assert shown.page.evaluate("JSON.parse(view.shown)[0]") == poses[1]
    shown.page.wait_for_timeout(300)
    assert shown.page.evaluate("complaints") == []


def test_the_canvas_follows_its_size_up_to_one_and_a_half_pixels(shown):
    """By hand: 120 x 180 on the page are so many pixels, and 180 x 270 at 3 device pixels each."""
    shown.open_view("wall")
    draw = "T => { view.draw(T); return [view.canvas.width, view.canvas.height]; }"
    pose = nose((0.0, 0.0, 1.0, 0.0, 0.0, 0.0)).ravel().tolist()
    assert shown.page.evaluate(draw, pose) == [WIDTH, HEIGHT]
    shown.page.evaluate("() => { view.canvas.style.width = '120px'; }")
    shown.page.wait_for_function("view.wanted[0] === 120")
    assert shown.page.evaluate(draw, pose) == [120, HEIGHT]
    ratio = "{ value: 3, configurable: true }"
    shown.page.evaluate(
        f"() => {{ Object.defineProperty(window, 'devicePixelRatio', {ratio}); view.measure(); }}"
    )
    assert shown.page.evaluate(draw, pose) == [180, 270]
    shown.page.evaluate(
        "width => { Object.defineProperty(window, 'devicePixelRatio', { value: 1 });"
        " view.canvas.style.width = width; }",
        f"{WIDTH}px",
    )


def test_a_still_page_gets_the_picture_of_its_order(shown):
    """One call of draw before any order is there: background only; the hall follows by itself."""
    shown.open_view("wall", background="#4080bf")
    camera = nose((0.0, 0.0, 1.0, 0.0, 0.0, 0.0)).ravel().tolist()
    first = "T => { view.draw(T, { fovDeg: 77.8 }); return view.canvas.toDataURL(); }"
    empty = shown.read(shown.page.evaluate(first, camera))
    assert np.allclose(empty, np.array([0x40, 0x80, 0xBF]) / 255.0, atol=0.6 / 255.0)
    shown.page.wait_for_function(
        "() => { window.pixel = new Uint8Array(4);"
        " view.gl.readPixels(120, 90, 1, 1, view.gl.RGBA, view.gl.UNSIGNED_BYTE, pixel);"
        " return pixel[0] > 180 && pixel[2] < 60; }"
    )


def test_a_slow_machine_gets_fewer_pixels(shown):
    """By the table: 40 frames of 60 ms take 3/4 of 240 x 180; quick ones give them back, but no
    more than three times, so that it cannot alternate; at 30 ms nothing changes.
    """
    shown.open_view("wall")
    pace = "ms => { for (let k = 0; k < 40; k += 1) view.keepPace(ms); return view.wanted; }"
    assert shown.page.evaluate(pace, 30) == [240, 180]
    assert shown.page.evaluate(pace, 60) == [180, 135]
    for _ in range(3):
        assert shown.page.evaluate(pace, 10) == [240, 180]
        assert shown.page.evaluate(pace, 60) == [180, 135]
    assert shown.page.evaluate(pace, 10) == [180, 135]
    for _ in range(4):
        lowest = shown.page.evaluate(pace, 100)
    assert lowest == [84, 63] and shown.page.evaluate("view.stats.share") == 0.35


def test_two_frames_of_half_a_second_take_the_fewest_pixels_at_once(shown):
    """By the table: 0.35 of 240 x 180. One such frame alone, as the first may be, changes nothing,
    nor does one after each quick one.
    """
    shown.open_view("wall")
    pace = "ms => { view.keepPace(ms); return view.wanted; }"
    for took in (500, 10, 500, *(30 * [10]), 500):
        assert shown.page.evaluate(pace, took) == [240, 180]
    assert shown.page.evaluate(pace, 500) == [84, 63]


def test_drawing_in_software_begins_with_the_fewest_pixels(shown):
    """This browser draws without a GPU; a view that keeps its pictures has them whole. The names
    are those that drivers without and with a GPU give themselves.
    """
    shown.open_view("wall", keep=False)
    assert shown.page.evaluate("view.wanted") == [84, 63]
    shown.open_view("wall")
    assert shown.page.evaluate("view.wanted") == [240, 180]
    ask = """name => splats.drawsInSoftware({ RENDERER: 1, getExtension: () => null,
        getParameter: (what) => (what === 1 ? name : "") })"""
    for name in (
        "ANGLE (Google, Vulkan 1.3.0 (SwiftShader Device (Subzero)), SwiftShader driver)",
        "ANGLE (Mesa, llvmpipe (LLVM 15.0.7, 256 bits), OpenGL 4.5)",
        "ANGLE (Microsoft, Microsoft Basic Render Driver (0x0000008C) Direct3D11 vs_5_0 ps_5_0)",
    ):
        assert shown.page.evaluate(ask, name), name
    for name in (
        "ANGLE (Intel, Mesa Intel(R) UHD Graphics 620 (KBL GT2), OpenGL 4.6)",
        "ANGLE (Apple, ANGLE Metal Renderer: Apple M1, Unspecified Version)",
        "Adreno (TM) 640",
    ):
        assert not shown.page.evaluate(ask, name), name


# Counts the frames, and asks for views from (0, y, 1) for each y, without a pause between them.
LOOK_FROM = """([Ts]) => {
  if (!view.painted) {
    const paint = view.paint;
    view.painted = [];
    view.paint = function (T, fovDeg) { this.painted.push(T[7]); paint.call(this, T, fovDeg); };
  }
  for (const T of Ts) view.draw(T);
  return view.painted;
}"""


def test_views_that_come_faster_than_frames_are_drawn_one_at_a_time(shown):
    """Of fifty views that come while the first is drawn, only the last one follows; once the order
    of that is there, the same view again draws nothing.
    """
    shown.open_view("wall", keep=False)
    ys = np.linspace(0.0, 0.5, 50).tolist()
    Ts = [nose((0.0, y, 1.0, 0.0, 0.0, 0.0)).ravel().tolist() for y in ys]
    y_cameras = [T[7] for T in Ts]
    assert shown.page.evaluate(LOOK_FROM, [Ts]) == y_cameras[:1]
    is_still = """() => view.painted.length > 1 && !view.frame && !view.sorting.busy
        && !view.order.fresh && view.order.T[7] === view.last[0][7]"""
    shown.page.wait_for_function(is_still)
    painted = shown.page.evaluate("view.painted")
    assert set(painted) == {y_cameras[0], y_cameras[-1]} and len(painted) <= 4
    assert shown.page.evaluate(LOOK_FROM, [Ts[-1:] * 10]) == painted
    shown.page.wait_for_timeout(300)  # `drawLater` draws after 100 ms
    assert shown.page.evaluate("view.painted") == painted
    # An aircraft that moves is a new picture of the same view.
    set_aircraft(shown, (at(2, 0, 1), None, 1))
    assert shown.page.evaluate(LOOK_FROM, [Ts[-1:]]) == [*painted, y_cameras[-1]]


@pytest.mark.parametrize(("name", "text"), [("text", "SPZ"), ("cut", "whole"), ("none", "404")])
def test_bytes_that_are_no_scene_are_a_sentence(shown, name, text):
    """Words, a file cut by one byte, and none at all."""
    sentence = shown.page.evaluate(
        "name => open_view(name).then(() => '', (error) => error.message)", name
    )
    assert sentence.startswith("scene: expected") and text in sentence


def test_a_browser_without_webgl_2_is_noticed(shown):
    """Its canvas returns no context: `supported` is false and the constructor says why."""
    answers = shown.page.evaluate(
        "() => { const proto = HTMLCanvasElement.prototype, { getContext } = proto;"
        " proto.getContext = () => null;"
        " let said = ''; try { new splats.SplatView(document.createElement('canvas')); }"
        " catch (error) { said = error.message; }"
        " const without = splats.SplatView.supported(); proto.getContext = getContext;"
        " return [without, splats.SplatView.supported(), said]; }"
    )
    assert answers[:2] == [False, True] and "WebGL2" in answers[2]


def test_modules_can_be_inlined():
    """As agreed for pages in one file: imports in one line each, exports before declarations."""
    for path in PAGE.glob("*.js"):
        text = path.read_text(encoding="utf-8")
        assert text.startswith("// "), path.name
        for line in text.splitlines():
            if line.startswith("import"):
                assert re.fullmatch(r'import \{ [\w, ]+ \} from "\./\w+\.js";', line), line
            if line.startswith("export"):
                assert re.match(r"export (async )?(function|class|const) \w+", line), line
