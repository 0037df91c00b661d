"""Lab 2, public: the exercises, what a right function does, and what a person looks for."""

import math

import numpy as np
from given import COHORT, Array

from falconwing_kit.tools.grading import Check, Criterion, Exercise, Function, Lab, is_same_answer

RUNWAY = math.radians(COHORT["runway_heading_deg"])
HALF, ROOT = 0.5, math.sqrt(0.75)  # sine and cosine of 30 deg
THIRTY, QUARTER = math.pi / 6.0, math.pi / 2.0
LENS = {"fx": 200.0, "fy": 300.0, "cx": 100.5, "cy": 80.5, "k1": -0.2}


def _columns(nose: list[float], wing: list[float], belly: list[float]) -> Array:
    return np.array([nose, wing, belly]).T


def _along_the_runway(rot: Function) -> bool:
    """By hand: level, along the runway: nose along (y), right wing right (x), belly down."""
    return is_same_answer(rot(0.0, 0.0, RUNWAY), _columns([0, 1, 0], [1, 0, 0], [0, 0, -1]))


def _yaw_right(rot: Function) -> bool:
    """By hand: 30 deg to the right of the runway, nose half right; the right wing swings back."""
    return is_same_answer(
        rot(0.0, 0.0, RUNWAY + THIRTY), _columns([HALF, ROOT, 0], [ROOT, -HALF, 0], [0, 0, -1])
    )


def _pitch_up(rot: Function) -> bool:
    """By hand: nose up 30 deg: the nose half up, the belly half forward."""
    return is_same_answer(
        rot(0.0, THIRTY, RUNWAY), _columns([0, ROOT, HALF], [1, 0, 0], [0, HALF, -ROOT])
    )


def _roll_right(rot: Function) -> bool:
    """By hand: right wing half down, the belly half left."""
    return is_same_answer(
        rot(THIRTY, 0.0, RUNWAY), _columns([0, 1, 0], [ROOT, 0, -HALF], [-HALF, 0, -ROOT])
    )


def _order(rot: Function) -> bool:
    """By hand: 30 deg right, 30 deg up, 90 rolled: the nose stays, the wing replaces the belly."""
    nose = [HALF * ROOT, ROOT * ROOT, HALF]
    belly_before = [HALF * HALF, ROOT * HALF, -ROOT]
    return is_same_answer(
        rot(QUARTER, THIRTY, RUNWAY + THIRTY), _columns(nose, belly_before, [-ROOT, HALF, 0])
    )


def _untilted(pose: Function) -> bool:
    """By hand: body axes as the map's, no tilt: columns are right wing (y), belly (z), nose (x)."""
    T = pose(np.eye(3), np.array([1.0, 2.0, 3.0]), np.zeros(3), 0.0)
    return is_same_answer(T, np.array([[0, 0, 1, 1], [1, 0, 0, 2], [0, 1, 0, 3], [0, 0, 0, 1.0]]))


def _tilted(pose: Function) -> bool:
    """By hand: 30 deg down: axis = nose cos + belly sin, image down = belly cos - nose sin."""
    T = pose(np.eye(3), np.zeros(3), np.zeros(3), THIRTY)
    return is_same_answer(T[:3, :3], np.array([[0, -HALF, ROOT], [1, 0, 0], [0, ROOT, HALF]]))


def _mount_turns(pose: Function) -> bool:
    """By hand: body x is map y, body y is map -x: (0.2, 0.1) in body is 0.2 along, 0.1 left."""
    R_map_body = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    T = pose(R_map_body, np.array([5.0, 0.0, 1.0]), np.array([0.2, 0.1, 0.0]), 0.3)
    looks = np.array([0.0, math.cos(0.3), math.sin(0.3)])
    return is_same_answer((T[:3, 3], T[:3, 2]), (np.array([4.9, 0.2, 1.0]), looks))


def _pose() -> tuple[Array, Array]:
    """A pose with three different axes: 0.6, 0.8 is a rotation by hand."""
    R = np.array([[0.6, 0.0, 0.8], [0.8, 0.0, -0.6], [0.0, 1.0, 0.0]])
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = R, (1.0, -2.0, 3.0)
    return T, R


def _itself(to_camera: Function) -> bool:
    T, _ = _pose()
    return is_same_answer(to_camera(T[None, :3, 3], T), np.zeros((1, 3)))


def _ahead(to_camera: Function) -> bool:
    """Points built as the lens plus so much of each axis must come back as that much.

    N = 3 is the treacherous one.
    """
    T, R = _pose()
    expected = np.array([[0.0, 0.0, 2.0], [1.0, 0.0, 3.0], [0.0, -1.5, 4.0]])
    built = np.array([T[:3, 3] + a * R[:, 0] + b * R[:, 1] + c * R[:, 2] for a, b, c in expected])
    return is_same_answer(to_camera(built, T), expected)


def _keeps_distances(to_camera: Function) -> bool:
    """A rotation and a shift: the distance between two points stays."""
    T, _ = _pose()
    p = np.array([[1.0, 2.0, 3.0], [4.0, -1.0, 0.0], [0.0, 0.0, 7.0], [2.0, 2.0, 2.0]])
    q = np.asarray(to_camera(p, T))
    return is_same_answer(
        np.linalg.norm(np.diff(q, axis=0), axis=1), np.linalg.norm(np.diff(p, axis=0), axis=1)
    )


def _axis_point(project: Function) -> bool:
    """By hand: the axis meets the picture at (cx, cy) - 1/2, at any depth."""
    return is_same_answer(
        project(np.array([[0.0, 0.0, 1.0], [0.0, 0.0, 9.0]]), LENS), np.array([[100.0, 80.0]] * 2)
    )


def _bent_by_hand(project: Function) -> bool:
    """By hand: slopes (0.5, -0.5), factor 0.9: u = 100 + 200 * 0.45, v = 80 - 300 * 0.45."""
    return is_same_answer(project(np.array([[1.0, -1.0, 2.0]]), LENS), np.array([[190.0, -55.0]]))


def _behind(project: Function) -> bool:
    """By hand: what is behind is nan in both; the others stay: slopes (1, 0), factor 0.8."""
    nan = float("nan")
    points = np.array([[1.0, 0.0, -1.0], [1.0, 0.0, 1.0], [0.0, 0.0, 0.0]])
    return is_same_answer(project(points, LENS), np.array([[nan, nan], [260.0, 80.0], [nan, nan]]))


def _looking_down() -> Array:
    """2 m above (3, 4), straight down: image right is right, image down is back."""
    return np.array(
        [[1.0, 0.0, 0.0, 3.0], [0.0, -1.0, 0.0, 4.0], [0.0, 0.0, -1.0, 2.0], [0.0, 0.0, 0.0, 1.0]]
    )


def _straight_down(ground: Function) -> bool:
    """By hand: 100 px right with f = 200 at 2 m is 1 m right.

    150 px down with f = 300 is 1 m back.
    """
    pixels = np.array([[100.0, 80.0], [200.0, 80.0], [100.0, 230.0], [200.0, 230.0]])
    expected = np.array([[3.0, 4.0, 0.0], [4.0, 4.0, 0.0], [3.0, 3.0, 0.0], [4.0, 3.0, 0.0]])
    return is_same_answer(ground(pixels, _looking_down(), LENS), expected)


def _looking_ahead() -> Array:
    """1.5 m above the origin, level, looking along the runway."""
    return np.array(
        [[1.0, 0.0, 0.0, 0.0], [0.0, 0.0, 1.0, 0.0], [0.0, -1.0, 0.0, 1.5], [0.0, 0.0, 0.0, 1.0]]
    )


def _horizon(ground: Function) -> bool:
    """By hand: level, 150 px below the middle with f = 300 is a slope of 1/2, 3 m ahead.

    Above, there is no floor.
    """
    nan = float("nan")
    pixels = np.array([[100.0, 230.0], [100.0, 20.0], [200.0, 230.0]])
    return is_same_answer(
        ground(pixels, _looking_ahead(), LENS),
        np.array([[0.0, 3.0, 0.0], [nan] * 3, [1.5, 3.0, 0.0]]),
    )


LAB = Lab(
    name="lab02",
    title="Frames and camera",
    hours=3.0,
    exercises=(
        Exercise(
            "rot_from_euler",
            15.0,
            (
                Check(
                    "level and along the runway: nose along, right wing right, belly down",
                    _along_the_runway,
                    "the heading counts from north, the runway's heading is in COHORT, in degrees; "
                    "the map's rows are "
                    "right, along, up",
                ),
                Check(
                    "turned right by 30 deg, the nose points right of the runway",
                    _yaw_right,
                    "positive yaw is to the right; which column is the nose?",
                ),
                Check(
                    "nose up by 30 deg, it rises",
                    _pitch_up,
                    "the map's third row is up, the textbook's is down",
                ),
                Check(
                    "rolled by 30 deg, the right wing drops",
                    _roll_right,
                    "look at the second column's last entry",
                ),
                Check(
                    "a roll does not move the nose, whatever came before",
                    _order,
                    "the roll stands rightmost: it turns about the nose that yaw and pitch have "
                    "placed",
                ),
            ),
        ),
        Exercise(
            "camera_pose",
            15.0,
            (
                Check(
                    "untilted, the camera's axes are right wing, belly, nose; "
                    "the last row is 0 0 0 1",
                    _untilted,
                    "the columns of R_body_camera are the camera's axes, written in the body",
                ),
                Check(
                    "tilted down, the axis leans to the belly and the picture's down leans to the "
                    "tail",
                    _tilted,
                    "body z is down: leaning down adds a positive z to the nose",
                ),
                Check(
                    "where the camera sits turns with the aircraft",
                    _mount_turns,
                    "R_map_body turns both: the camera's axes, and p_body_camera before you add it",
                ),
            ),
        ),
        Exercise(
            "map_to_camera",
            15.0,
            (
                Check(
                    "the camera sees itself at 0, 0, 0",
                    _itself,
                    "subtract the lens before you turn",
                ),
                Check(
                    "a point so far right, down and ahead comes back as these numbers",
                    _ahead,
                    "the inverse of a rotation is its transpose; "
                    "with points in rows the matrix changes sides",
                ),
                Check(
                    "distances between points stay",
                    _keeps_distances,
                    "one shift and one rotation, nothing else",
                ),
            ),
        ),
        Exercise(
            "project_points",
            15.0,
            (
                Check(
                    "the optical axis meets the picture half a pixel before cx, cy",
                    _axis_point,
                    "the first pixel's centre is (0.5, 0.5) for the kit and (0, 0) for you",
                ),
                Check(
                    "slopes of 0.5 and -0.5 are bent by 1 + k1 / 2",
                    _bent_by_hand,
                    "divide by z first; r^2 is of the slopes, the same factor for both",
                ),
                Check(
                    "what is not in front is nan, and only that",
                    _behind,
                    "np.where on z, before you divide",
                ),
            ),
        ),
        Exercise(
            "ground_points",
            15.0,
            (
                Check(
                    "from 2 m straight down, 1 m is f / 2 pixels",
                    _straight_down,
                    "undo the half pixel; walk until z = 0, and return z = 0",
                ),
                Check(
                    "half a slope below the horizon the floor is twice the height away; "
                    "above there is none",
                    _horizon,
                    "turn the ray into the map; only rays whose map z is negative meet the floor",
                ),
            ),
        ),
    ),
    rubric=(
        Criterion(
            "axes",
            11.0,
            "both overlays lie on pad and marker, arrows right, along, up; "
            "footprints begin before each camera",
        ),
        Criterion(
            "axes_reading",
            4.0,
            "roll: turned by twice its angle; tilt: all lines lower; k1: a pixel here, "
            "many in the corners",
        ),
        Criterion(
            "q1",
            5.0,
            "sign of the roll, angle twice the roll; without the runway's heading all moves "
            "sideways",
        ),
        Criterion(
            "q2",
            5.0,
            "2.5 mrad or 2.5 cm at 10 m; no for landing, yes for renders and for fits, "
            "as it has a sign",
        ),
    ),
    constants={"runway_heading_deg": (20.0, 60.0, 0)},
)
