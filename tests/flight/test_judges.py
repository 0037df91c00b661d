"""Judges: geometry of the lock, tracking errors and landings, by hand."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from falconwing_kit.aircraft.airframe import load_airframe
from falconwing_kit.aircraft.touchdown import Touchdown
from falconwing_kit.control.leader import LeaderPath
from falconwing_kit.core.frames import camera_pose
from falconwing_kit.core.messages import Command, State
from falconwing_kit.flight.judges import (
    FollowEvaluator,
    LandingEvaluator,
    is_in_hull,
    is_locked,
    outline_pixels,
    path_coordinates,
    tracking_errors,
)
from falconwing_kit.flight.loop import LoopStep
from falconwing_kit.flight.sources import RenderedView, fpv_camera
from falconwing_kit.flight.world import Contact
from falconwing_kit.scene import GaussianScene, load_scene
from falconwing_kit.scene.arena import leader_at
from falconwing_kit.scene.masks import visible_alpha_image

AIRFRAME = load_airframe()
LEVEL = State.from_vector(np.zeros(9))
FROM_ORIGIN = camera_pose(np.array(LEVEL.pose.T_world_body))  # looks along x from the origin
OUTLINE_M2 = (
    0.5 * (0.70 + 0.16) * 0.11
)  # seen from behind: a trapezium, wing tips above, main wheels below


def at(x: float, y: float, z: float, **angles: float) -> State:
    return replace(LEVEL, p_world=np.array([x, y, z]), **angles)


@pytest.mark.parametrize("distance", [4.0, 8.0, 12.0])
def test_visible_area_is_that_of_the_trapezium_of_tips_and_wheels(distance):
    """Area times (focal length / distance)^2; 3 %: the wheels are 5 cm nearer, and pixels are
    counted.
    """
    camera = fpv_camera(1920, 1440)
    pixels = outline_pixels(camera, FROM_ORIGIN, at(distance, 0.0, 0.0), AIRFRAME)
    assert pixels == pytest.approx(OUTLINE_M2 * (0.62 * 1920 / distance) ** 2, rel=0.03)


def test_from_the_side_the_leader_is_as_long_as_its_body():
    """Yawed by 90 deg: 0.52 m from nose to tail, 0.20 m of it right of the centre."""
    camera, leader = fpv_camera(1920, 1440), at(8.0, 0.0, 0.0, yaw=np.pi / 2)
    scale = 0.62 * 1920 / 8.0
    whole = outline_pixels(camera, FROM_ORIGIN, leader, AIRFRAME)
    # Seen from its left side: nose, main wheels and tail wheel below the line from nose to tail.
    corners = np.array([(0.20, 0.0), (0.05, 0.11), (-0.30, 0.04), (-0.32, 0.0)])
    x, y = corners.T
    area = 0.5 * abs(np.dot(x, np.roll(y, 1)) - np.dot(y, np.roll(x, 1)))
    assert whole == pytest.approx(
        area * scale**2, rel=0.08
    )  # its wheels are up to 8 cm nearer or farther


@pytest.mark.parametrize(
    ("leader", "locked"),
    [
        (at(8.0, 0.0, 0.0), True),
        (at(15.0, 0.0, 0.0), True),  # 0.0473 (198.4 / 15)^2 = 8.3 px
        (at(30.0, 0.0, 0.0), False),  # 2.1 px
        (at(-8.0, 0.0, 0.0), False),  # behind
        (at(8.0, 8.0 * 0.5 / 0.62 - 0.1, 0.0), True),  # centre 0.1 m inside the left edge
        (
            at(8.0, 8.0 * 0.5 / 0.62 + 0.1, 0.0),
            False,
        ),  # centre 0.1 m outside, a wing tip still inside
        (at(8.0, 0.0, 8.0 * 0.375 / 0.62 + 0.1), False),  # above the upper edge
    ],
    ids=["near", "far", "too far", "behind", "left edge", "beyond the left edge", "above"],
)
def test_lock_needs_the_centre_inside_in_front_and_six_pixels(leader, locked):
    """320 x 240 with f = 198.4 px: bearings and areas by hand."""
    assert is_locked(fpv_camera(), FROM_ORIGIN, leader, AIRFRAME) is locked


def plate(half_sizes: tuple[float, float, float], label: str = "leader") -> GaussianScene:
    """An opaque plate around the origin: Gaussians 1 cm apart; half sizes in body axes [m]."""
    axes = [np.arange(-h, h + 1e-9, 0.01) if h > 0.005 else np.zeros(1) for h in half_sizes]
    means = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
    n = len(means)
    return GaussianScene(
        means.astype(np.float32), np.tile(np.float32([1, 0, 0, 0]), (n, 1)),
        np.full((n, 3), 0.004, np.float32), np.full(n, 0.95, np.float32),
        np.zeros((n, 1, 3), np.float32), np.zeros(n, np.uint8), (label,),
    )  # fmt: skip


def view_of(leader: GaussianScene, pose: State, hall: GaussianScene | None = None) -> RenderedView:
    """A view from the origin along x, of a leader at a pose in a hall."""
    world = SimpleNamespace(state=LEVEL, leader_state=pose)
    far = plate((0.0, 0.02, 0.02), "hall")
    far = replace(far, means=far.means + np.float32([60.0, 0.0, 0.0])) if hall is None else hall
    return RenderedView(world, GaussianScene.joined(far, leader), fpv_camera())


def locked_and_pixels(view: RenderedView, pose: State) -> tuple[bool, int]:
    share = view.leader_share
    locked = is_locked(view.camera, view.T_world_camera, pose, AIRFRAME, share)
    return locked, int((share() >= 0.5).sum())


def test_a_wing_seen_edge_on_is_not_locked_and_its_upper_side_is():
    """A wing of 0.70 x 0.11 x 0.01 m at 8 m, 24.8 px/m: edge-on it is 0.25 px thick, so no pixel is
    half of it, where the outline down to the wheels has 29 px. Pitched up by 90 deg it shows
    17.4 x 2.7 px = 47 px (+- its edge of 40 px, half a pixel wide).
    """
    wing = plate((0.055, 0.35, 0.0))
    edge_on, upper = at(8.0, 0.0, 0.0), at(8.0, 0.0, 0.0, pitch=np.pi / 2)
    assert outline_pixels(fpv_camera(), FROM_ORIGIN, edge_on, AIRFRAME) == pytest.approx(29, abs=4)
    assert locked_and_pixels(view_of(wing, edge_on), edge_on) == (False, 0)
    locked, pixels = locked_and_pixels(view_of(wing, upper), upper)
    assert locked and pixels == pytest.approx(47, abs=20)


def test_what_is_nearer_hides_the_leader_and_what_is_farther_does_not():
    """A wing across the view at 8 m. A wall at 4 m over all of it: not locked; over its right half:
    half of the pixels; at 12 m, or of one tenth of opacity (a floater of a trained hall): all.
    """
    wing, pose = plate((0.055, 0.35, 0.0)), at(8.0, 0.0, 0.0, pitch=np.pi / 2)
    free = locked_and_pixels(view_of(wing, pose), pose)[1]
    panel = plate((0.0, 0.4, 0.2), "hall")

    def wall(x: float, y: float = 0.0, opacity: float = 0.95) -> GaussianScene:
        moved = panel.means + np.float32([x, y, 0.0])
        return replace(panel, means=moved, opacities=np.full(len(panel), opacity, np.float32))

    for hall, expected in ((wall(4.0), 0), (wall(12.0), free), (wall(4.0, opacity=0.02), free)):
        locked, pixels = locked_and_pixels(view_of(wing, pose, hall), pose)
        assert pixels == pytest.approx(expected, abs=3) and locked is (expected > 0)
    half = locked_and_pixels(view_of(wing, pose, wall(4.0, y=-0.4)), pose)[1]
    assert half == pytest.approx(free / 2, abs=4)


def test_a_ceiling_near_the_lens_hides_what_it_hides_in_the_image():
    """Just under the hall's ceiling, behind a leader that is to be seen: as many pixels as in the
    whole image, four times as fine and averaged. Drawn around the leader alone, the ceiling's
    Gaussians beside the lens were projected otherwise and left none.
    """
    follower = State.from_vector([-20.604, -5.35, 3.794, 0.055, 0.064, -0.029, 7, 0, 0, 0, 0, 0])
    pose = State.from_vector([-16.49, -5.04, 3.528, 0.085, 0, 0, 7, 0, 0, 0, 0, 0])
    world = SimpleNamespace(state=follower, leader_state=pose)
    view = RenderedView(world, load_scene("hall"), fpv_camera(), AIRFRAME.p_body_camera)
    leader = leader_at(load_scene("leader"), pose.pose.T_world_body)
    T_world_camera = view.T_world_camera
    whole = visible_alpha_image(load_scene("hall"), leader, fpv_camera(1280, 960), T_world_camera)
    count = int((whole.reshape(240, 4, 320, 4).mean(axis=(1, 3)) >= 0.5).sum())
    locked, pixels = locked_and_pixels(view, pose)
    assert locked and count > 50
    assert pixels == pytest.approx(count, rel=0.2)  # that widens edges by half a fine pixel


def test_the_share_of_the_leader_is_that_of_the_whole_image():
    """Drawn only around the leader, at an edge, partly outside, and near: as many pixels as in the
    whole image, four times as fine by `visible_alpha_image` and averaged; 4 %, because that widens
    edges by half a fine pixel.
    """
    box, counts = plate((0.2, 0.35, 0.1)), []
    for p in ((6.0, 0.0, 0.0), (6.0, 4.8, 0.0), (6.0, 0.0, 3.6), (0.3, 0.2, 0.0), (6.0, 9.0, 0.0)):
        pose = at(*p)
        view = view_of(box, pose)
        hall = view_of(box, at(-50.0, 0.0, 0.0))._hall
        placed = leader_at(GaussianScene.joined(hall, box), pose.pose.T_world_body)
        leader = placed.selected(placed.labelled("leader"))
        whole = visible_alpha_image(hall, leader, fpv_camera(1280, 960), view.T_world_camera)
        count = int((whole.reshape(240, 4, 320, 4).mean(axis=(1, 3)) >= 0.5).sum())
        share = view.leader_share()
        assert int((share >= 0.5).sum()) == pytest.approx(count, rel=0.04, abs=4)
        counts.append(count)
    assert counts[0] > counts[1] > 30 and counts[-1] == 0


def test_what_is_not_drawn_of_the_hall_hides_nothing(monkeypatch):
    """The share to the bit as with the whole hall, on a flight from wall to wall behind a leader;
    most of the hall is not drawn.
    """
    poses = [(np.array([x, 0.6 * x, 1.5, 0.05, 0.3 * x, 0.4, *6 * [0.0]]), d)
             for x, d in ((-9.0, 3.0), (-4.0, 6.0), (2.0, 9.0), (8.0, 4.0))]  # fmt: skip
    world = SimpleNamespace(state=LEVEL, leader_state=LEVEL)
    view = RenderedView(world, load_scene("hall"), fpv_camera(), AIRFRAME.p_body_camera)

    def shares():
        for follower, distance in poses:
            world.state = State.from_vector(follower)
            ahead = world.state.pose.T_world_body @ (distance, 0.3, -0.2, 1.0)
            world.leader_state = State.from_vector([*ahead[:3], *follower[3:]])
            yield view.leader_share()

    hall = view._black_and_white[0]
    drawn = [sum(map(len, view._hall_before(distance))) for _, distance in poses]
    assert all(count < 0.5 * len(hall) for count in drawn)
    quick = list(shares())
    monkeypatch.setattr(RenderedView, "_hall_before", lambda self, farthest: [hall])
    for share, whole in zip(quick, shares(), strict=True):
        assert share.sum() > 1.0 and np.array_equal(share, whole)


def test_hull_of_a_square_with_a_point_inside():
    """By hand: the inner corner point changes nothing, collinear corners have no interior."""
    corners = np.array([(0.0, 0.0), (4.0, 0.0), (4.0, 4.0), (0.0, 4.0), (1.0, 2.0)])
    points = np.array([(2.0, 2.0), (0.1, 3.9), (4.1, 2.0), (-0.1, -0.1), (3.9, 0.1)])
    assert is_in_hull(points, corners).tolist() == [True, True, False, False, True]
    assert not is_in_hull(points, np.array([(0.0, 0.0), (1.0, 1.0), (2.0, 2.0)])).any()


def straight(n: int, x: float = 0.0, y: float = 0.0, z: float = 2.0) -> np.ndarray:
    """n positions along x, 0.35 m apart."""
    return np.column_stack([x + 0.35 * np.arange(n), np.full(n, y), np.full(n, z)])


def errors(leader: np.ndarray, follower: np.ndarray, path: np.ndarray) -> list[float]:
    """ATE, ATE_d, ATE_path; the leader's velocity from differences, only its direction counts."""
    return list(tracking_errors(leader, np.gradient(leader, axis=0), follower, path).values())


def test_a_constant_offset_is_no_error():
    """4 m behind, 0.5 m to the side and below: all errors are 0."""
    path = straight(200, x=-20.0)
    assert errors(straight(60), straight(60, x=-4.0, y=0.5, z=1.5), path) == pytest.approx(
        [0.0] * 3, abs=1e-9
    )


@pytest.mark.parametrize(
    ("axis", "ate_d"),
    [(0, 0.5), (1, 0.5 * (np.sqrt(17.0) - 4.0)), (2, 0.5 * (np.sqrt(17.0) - 4.0))],
)
@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_a_step_of_a_metre_for_half_of_the_time_is_half_a_metre(axis, sign, ate_d):
    """4 m behind; 1 m off along one axis in the second half. The distance changes by 1 or sqrt(17)
    - 4.
    """
    follower = straight(60, x=-4.0)
    follower[30:, axis] += sign
    found = errors(straight(60), follower, straight(200, x=-20.0))
    assert found == pytest.approx([0.5, ate_d, 0.5], abs=1e-9)


def circle(angle: np.ndarray, radius: np.ndarray | float = 10.0) -> np.ndarray:
    """A level turn to the right around the origin, 2 m up."""
    return np.column_stack(
        [radius * np.cos(angle), -radius * np.sin(angle), np.full(len(angle), 2.0)]
    )


def course(angle: np.ndarray) -> np.ndarray:
    """Directions of flight on the circle."""
    return np.column_stack([-np.sin(angle), -np.cos(angle), np.zeros(len(angle))])


def test_following_the_same_circle_at_the_same_distance_has_no_error():
    """Circle of 10 m, 4 m of arc behind; chords of 0.35 m leave it by 0.35^2 / 80 = 1.5 mm.

    One metre further out for half of the time is 0.5 m, in a turn too.
    """
    when, path = np.linspace(0.8, 3.8, 100), circle(np.arange(0.0, 4.0, 0.035))
    leader = circle(when)
    found = tracking_errors(leader, course(when), circle(when - 0.4), path)
    assert list(found.values()) == pytest.approx([0.0] * 3, abs=0.004)
    outside = circle(when - 0.4, np.where(np.arange(100) < 50, 10.0, 11.0))
    found = tracking_errors(leader, course(when), outside, path)
    assert (found["ate_m"], found["ate_path_m"]) == (
        pytest.approx(0.5, abs=0.005),
        pytest.approx(0.5, abs=0.005),
    )


def test_entering_a_turn_adds_to_ate_and_not_to_ate_path():
    """60 frames straight, then 80 on a circle of 10 m; always 4 m of path behind, twelve frames of
    0.35 m.

    On the circle the follower is R sin(0.4) behind and R (1 - cos(0.4)) beside the course, at first
    4 m behind: |D - D(0)| = hypot(4 - 3.894, 0.789) = 0.796, in 68 to 80 of 120 frames, less at
    entry.
    """
    angle = np.concatenate([np.zeros(60), 0.035 * np.arange(80)])
    path = circle(angle)
    path[:60, 1] = 0.35 * np.arange(60, 0, -1)
    s = 0.35 * np.arange(140)
    behind = np.column_stack([np.interp(s[20:] - 4.0, s, path[:, axis]) for axis in range(3)])
    found = tracking_errors(path[20:], course(angle[20:]), behind, path)
    off = np.hypot(4.0 - 10.0 * np.sin(0.4), 10.0 - 10.0 * np.cos(0.4))
    assert 68 / 120 * off < found["ate_m"] < 80 / 120 * off
    assert found["ate_path_m"] == pytest.approx(0.0, abs=0.004)


def test_path_coordinates_are_along_left_and_up():
    """Path along -y (a course to the right): left is +x. Half a metre left, 0.2 m up, 3 m along."""
    path = np.array([(0.0, 0.0, 1.0), (0.0, -5.0, 1.0), (0.0, -10.0, 1.0)])
    assert path_coordinates(np.array([(0.5, -3.0, 1.2)]), path)[0] == pytest.approx([3.0, 0.5, 0.2])


def test_a_path_that_crosses_itself_is_followed_in_order():
    """Out along x, back across it: at the crossing the next arc length is found, not the earlier
    one.
    """
    out = np.column_stack([np.arange(0.0, 20.1, 0.5), np.zeros(41), np.zeros(41)])
    back = np.column_stack([np.linspace(20.0, 5.0, 40), np.linspace(0.0, 6.0, 40), np.zeros(40)])
    over = np.column_stack([np.full(20, 5.0), np.linspace(5.5, -5.5, 20), np.zeros(20)])
    path = np.concatenate([out, back[1:], over])
    along = path_coordinates(path, path)[:, 0]
    assert along == pytest.approx(
        np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(path, axis=0), axis=1))])
    )


def still_world(**fields):
    """A world with fields set by the test."""
    return SimpleNamespace(**{"t": 0.0, "state": at(0.0, 0.0, 2.0), "contact": None, **fields})


def straight_leader(n: int) -> LeaderPath:
    states = np.zeros((n, 12))
    states[:, 0:3], states[:, 6] = straight(n, x=4.0), 7.0
    return LeaderPath("straight", 0, 0.05 * np.arange(n), states)


def fly_behind(offsets: dict[int, float], n: int = 41, contact_at: int | None = None):
    """The evaluation of following 4 m behind; at some steps the follower's nose points away by an
    angle.
    """
    world = still_world()
    judge, words = FollowEvaluator(world, straight_leader(n), AIRFRAME, fpv_camera()), []
    for k in range(n):
        world.t, world.state = 0.05 * k, at(0.35 * k, 0.0, 2.0, yaw=offsets.get(k, 0.0))
        if k == contact_at:
            world.contact = Contact(world.t, "wall", world.state.p_world)
        words.append(judge.watch(LoopStep(world.t, None, None, Command(0, 0, 0, 0), "", None)))
    return judge.result(), words


def test_lock_in_all_frames_is_success():
    """The follower keeps its place: all errors are 0."""
    result, words = fly_behind({})
    assert (result["success"], result["locked_share"], result["lost_at_s"]) == (True, 1.0, None)
    assert result["ate_m"] == pytest.approx(0.0, abs=1e-9)
    assert set(words) == {""}
    assert len(result["path_m"]) == len(result["leader_path_m"]) == 41


def test_one_frame_without_lock_is_a_failure_and_ends_the_error():
    """The nose 1 rad away at frame 10 (half the field is 0.68): 40 of 41 locked, lost at 0.5 s."""
    result, _ = fly_behind({10: 1.0})
    assert (result["success"], result["lost_at_s"]) == (False, pytest.approx(0.5))
    assert result["locked_share"] == pytest.approx(40 / 41)
    assert result["ate_m"] == pytest.approx(0.0, abs=1e-9)
    blind, _ = fly_behind({0: 1.0})
    assert (blind["lost_at_s"], blind["ate_m"], blind["ate_d_m"]) == (0.0, None, None)


def test_a_contact_is_a_failure_with_its_reason():
    """In lock, but in contact with the wall."""
    result, words = fly_behind({}, contact_at=40)
    assert not result["success"]
    assert words[-1] == "touched wall"


def touchdown(surface: str) -> Touchdown:
    numbers = {"sink_rate": 0.4, "speed": 6.5, "bank": 0.05, "pitch": 0.1, "yaw": 0.0}
    place = np.array([4.0, -2.3, 0.1])
    return Touchdown(
        3.0, "main_left", surface, place, place, lateral_offset=-0.3, past_threshold=3.0, **numbers
    )


@pytest.mark.parametrize(
    ("surface", "success", "ald"),
    [("pad", True, 0.3), ("floor", False, None), ("pad edge", False, None)],
)
def test_only_a_touchdown_on_the_pad_counts_and_has_a_deviation(surface, success, ald):
    """30 cm right of the centre line: ALD 0.30 m on the pad, none elsewhere, never zero."""
    world = still_world(contact=Contact(3.0, surface, np.zeros(3), touchdown(surface)))
    judge = LandingEvaluator(world)
    assert (
        judge.watch(LoopStep(3.0, None, None, Command(0, 0, 0, 0), "", None))
        == f"touched {surface}"
    )
    result = judge.result()
    assert (result["success"], result["ald_m"]) == (success, ald)
    assert (result["lateral_offset_m"], result["sink_rate_m_s"]) == (-0.3, 0.4)
    assert result["bank_deg"] == pytest.approx(np.degrees(0.05))


def test_a_flight_that_touches_no_ground_is_no_landing():
    """Still in the air at the end, or into the wall."""
    assert LandingEvaluator(still_world()).result() == {"success": False, "path_m": []}
    wall = still_world(contact=Contact(3.0, "wall", np.zeros(3)))
    assert LandingEvaluator(wall).result()["success"] is False
