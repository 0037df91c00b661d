"""Lab 9: its exercises, what a student can check, and what a person grades."""

import math

import numpy as np
from given import DICE_WEIGHT, GAMMA, MIN_PIXELS, POS_WEIGHT

from falconwing_kit.tools.grading import Check, Criterion, Exercise, Function, Lab, is_same_answer

FREE = np.full((40, 60), np.inf)  # nothing hides anything
BALL, MIDDLE = np.full(3, 1.0), np.zeros(3)
SPECK = np.full(3, 0.02)  # at 2 m and f = 100 it covers 1 pixel around its centre


def _pose(x: float, y: float, z: float, R: np.ndarray | None = None) -> np.ndarray:
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = np.eye(3) if R is None else R, (x, y, z)
    return T


def _quarter_turn() -> np.ndarray:
    """Body x to camera y, body y to camera -x: a quarter turn about the line of sight."""
    return np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])


def _covers(f: Function, expected: list[tuple[int, int]], *arguments: object) -> bool:
    mask = np.asarray(f(*arguments))
    return mask.dtype == bool and sorted(map(tuple, np.argwhere(mask).tolist())) == sorted(expected)


def _disc(f: Function) -> bool:
    """A ball of radius 1 at 5 m: tangents at tan^2 = 1 / 24, so with f = 60 a disc of 12.247 px."""
    row, column = np.indices((40, 60)) + 0.5
    expected = (column - 30.0) ** 2 + (row - 20.0) ** 2 <= 60.0**2 / 24.0
    return is_same_answer(f(_pose(0, 0, 5), MIDDLE, BALL, 60.0, FREE), expected)


def _span(mask: np.ndarray) -> tuple[int, int]:
    """Rows and columns that a mask reaches over."""
    return int(mask.any(axis=1).sum()), int(mask.any(axis=0).sum())


def _flat_one(f: Function, R: np.ndarray | None = None) -> tuple[int, int]:
    return _span(np.asarray(f(_pose(0, 0, 10, R), MIDDLE, np.array([1.0, 0.3, 0.3]), 100.0, FREE)))


def _half_hidden(f: Function) -> bool:
    depth = np.where(np.arange(60) < 30, 3.9, 4.1) * np.ones((40, 1))
    mask = np.asarray(f(_pose(0, 0, 5), MIDDLE, BALL, 60.0, depth))
    return not mask[:, :30].any() and bool(mask[20, 30]) and bool(mask[19, 30])


MASK_CHECKS = (
    Check(
        "a ball of radius 1 m at 5 m with f = 60 px is a disc of radius 60 / sqrt(24) = 12.2 px "
        "around the middle",
        _disc,
        "A pixel's centre is half a pixel from its corner; "
        "the outline is where the square root is 0.",
    ),
    Check(
        "a speck 0.3 m to the right and 0.1 m down at 2 m, f = 100 px: columns 44 and 45, "
        "rows 24 and 25",
        lambda f: _covers(
            f,
            [(24, 44), (24, 45), (25, 44), (25, 45)],
            _pose(0.3, 0.1, 2.0),
            MIDDLE,
            SPECK,
            100.0,
            FREE,
        ),
        "x goes right with the columns, y goes down with the rows; the middle is at W/2 and H/2.",
    ),
    Check(
        "nothing is seen of what lies behind the camera",
        lambda f: not np.asarray(f(_pose(0, 0, -5), MIDDLE, BALL, 60.0, FREE)).any(),
        "The depth must be positive.",
    ),
    Check(
        "half axes 1, 0.3, 0.3 m at 10 m: wide along x; turned by a quarter about the line of "
        "sight it is high",
        lambda f: _flat_one(f) == (6, 20) and _flat_one(f, _quarter_turn()) == (20, 6),
        "Divide by the half axes in body axes, after the turn.",
    ),
    Check(
        "the turn goes the right way: a centre 1 m along body x is seen below the middle after the "
        "quarter turn",
        lambda f: _covers(
            f,
            [(29, 29), (29, 30), (30, 29), (30, 30)],
            _pose(0, 0, 10, _quarter_turn()),
            np.array([1.0, 0, 0]),
            5 * SPECK,
            100.0,
            FREE,
        ),
        "T_camera_body leads from body to camera; rays go the other way. "
        "Is the centre's sign right?",
    ),
    Check(
        "a wall at 3.9 m hides a ball that begins at 4 m, a wall at 4.1 m does not hide its middle",
        _half_hidden,
        "Compare the depth where the ray enters with the hall's, pixel by pixel.",
    ),
    Check(
        "away from the picture's middle too, depth is along z, not along the ray",
        lambda f: bool(
            np.asarray(f(_pose(2.4, 0, 10), MIDDLE, 0.2 * BALL, 100.0, np.full((40, 60), 9.95)))[
                20, 54
            ]
        ),
        "With d = (.., .., 1) the s of s d is the depth.",
    ),
)


def _boxes(*boxes: tuple[int, int, int, int]) -> np.ndarray:
    """Masks of 8 x 10 with one box each: rows from, to, columns from, to."""
    masks = np.zeros((len(boxes), 8, 10), bool)
    for mask, (top, bottom, left, right) in zip(masks, boxes, strict=True):
        mask[top:bottom, left:right] = True
    return masks


def _rates(
    f: Function, got: np.ndarray, truth: np.ndarray, overlap: list[float], alarm: list[bool]
) -> bool:
    return is_same_answer(f(0.2 + 0.6 * got, truth, 0.5), (np.array(overlap), np.array(alarm)))


NOTHING = (0, 0, 0, 0)
IOU_CHECKS = (
    Check(
        "two boxes of 4 x 4 that share 2 x 4: 8 / 24 = 1/3; the same box twice: 1; boxes apart: 0",
        lambda f: _rates(
            f,
            _boxes((0, 4, 0, 4), (1, 3, 2, 5), (0, 2, 0, 2)),
            _boxes((2, 6, 0, 4), (1, 3, 2, 5), (4, 6, 6, 9)),
            [1 / 3, 1.0, 0.0],
            [False] * 3,
        ),
        "Shared pixels by those of either; one number for each picture.",
    ),
    Check(
        "nothing there and nothing marked: IoU 1, no alarm",
        lambda f: _rates(
            f,
            _boxes(NOTHING, (0, 2, 0, 2)),
            _boxes(NOTHING, (0, 2, 0, 2)),
            [1.0, 1.0],
            [False, False],
        ),
        "0 / 0 is your decision here.",
    ),
    Check(
        f"nothing there: {MIN_PIXELS} marked pixels are a false alarm, {MIN_PIXELS - 1} are none, "
        "the IoU is 0 in both",
        lambda f: _rates(
            f,
            _boxes((0, 1, 0, MIN_PIXELS), (0, 1, 0, MIN_PIXELS - 1)),
            _boxes(NOTHING, NOTHING),
            [0.0, 0.0],
            [True, False],
        ),
        "At least MIN_PIXELS.",
    ),
    Check(
        "where a leader is, a wrong mark is no false alarm; a missed leader has IoU 0",
        lambda f: _rates(
            f,
            _boxes((0, 4, 0, 4), NOTHING),
            _boxes((5, 7, 5, 7), (0, 2, 0, 2)),
            [0.0, 0.0],
            [False, False],
        ),
        "A false alarm needs an empty truth.",
    ),
    Check(
        "the threshold is obeyed, and a probability equal to it is not marked",
        lambda f: is_same_answer(
            f(np.array([[[0.3, 0.4, 0.9, 0.3]]]), np.array([[[True, True, True, False]]]), 0.3),
            (np.array([2 / 3]), np.array([False])),
        ),
        "Above the threshold, not at it.",
    ),
)


def _loss(f: Function, logits: list, truth: list) -> float:
    return float(f(np.array(logits, float), np.array(truth, float))["loss"])


def _even(f: Function) -> bool:
    """All logits 0: p = 1/2. One leader pixel of four: entropy (w + 3) ln 2 / 4.

    Overlap (1 + 1) / (2 + 1 + 1).
    """
    expected = (POS_WEIGHT + 3.0) * math.log(2.0) / 4.0 + DICE_WEIGHT * (1.0 - 2.0 / 4.0)
    return is_same_answer(_loss(f, [[[0.0, 0.0], [0.0, 0.0]]], [[[1, 0], [0, 0]]]), expected)


def _two_pictures(f: Function) -> bool:
    """Confident, correct in the first and wrong in the second: overlaps 1 and 1 / 3."""
    wrong = 40.0 * (POS_WEIGHT + 1.0) / 4.0
    got = _loss(f, [[[40.0, -40.0]], [[40.0, -40.0]]], [[[1, 0]], [[0, 1]]])
    return is_same_answer(got, wrong + DICE_WEIGHT * 0.5 * (1.0 - 1.0 / 3.0))


def _gradient(f: Function) -> bool:
    """Logits 0 and truth 1, 0: D = 2/3, dD/dp = 4/9 and -2/9, dp/dz = 1/4.

    The entropy gives -w/4 and 1/4.
    """
    expected = [-POS_WEIGHT / 4.0 - DICE_WEIGHT / 9.0, 0.25 + DICE_WEIGHT / 18.0]
    return is_same_answer(
        f(np.zeros((1, 1, 2)), np.array([[[1.0, 0.0]]]))["gradient"], np.array([[expected]])
    )


LOSS_CHECKS = (
    Check(
        "sure and right costs nothing: logits 40 on the leader and -40 elsewhere give 0",
        lambda f: is_same_answer(
            _loss(f, [[[40.0, -40.0], [-40.0, -40.0]]], [[[1, 0], [0, 0]]]), 0.0, 0.0, 1e-9
        ),
        "p is the sigmoid of the logit; the Dice part is then 1 - 1.",
    ),
    Check(
        "logits 0, one leader pixel of four: by hand (POS_WEIGHT + 3) ln 2 / 4 + DICE_WEIGHT / 2",
        _even,
        "The weight belongs to the leader's pixels; the mean is over all pixels.",
    ),
    Check(
        "two pictures, one right and one wrong: the Dice part is taken for each picture, "
        "then averaged",
        _two_pictures,
        "Sum over rows and columns only: dim=(1, 2).",
    ),
    Check(
        "an empty picture, rightly left empty, costs nothing",
        lambda f: is_same_answer(_loss(f, [[[-40.0, -40.0]]], [[[0, 0]]]), 0.0, 0.0, 1e-9),
        "This is what the two 1s are for.",
    ),
    Check(
        "logits of 800 with the wrong sign give a finite loss",
        lambda f: is_same_answer(
            _loss(f, [[[800.0]]], [[[0]]]) + _loss(f, [[[-800.0]]], [[[1]]]),
            800.0 * (1.0 + POS_WEIGHT) + DICE_WEIGHT * (0.5 + 0.5),
        ),
        "logsigmoid, not log of sigmoid.",
    ),
    Check(
        "the gradient is the one by hand: -w/4 - d/9 for the leader and 1/4 + d/18 for the hall "
        "(w, d: the weights)",
        _gradient,
        "Nothing may be rounded to 0 and 1 on the way: backward() goes through the probabilities "
        "in both parts.",
    ),
)

PLAIN = {"tint": np.ones(3), "brightness": 1.0, "salt": 0.0}


def _picture() -> tuple[np.ndarray, np.ndarray]:
    """6 x 8 pixels of (100, 150, 200), the leader on rows 2, 3 and columns 3, 4."""
    mask = np.zeros((6, 8), bool)
    mask[2:4, 3:5] = True
    return np.full((6, 8, 3), (100, 150, 200), np.uint8), mask


def _made(
    f: Function,
    patch: object = ((10, 20, 30),),
    corner: tuple[int, int] = (0, 0),
    **changes: object,
) -> np.ndarray:
    image, mask = _picture()
    how = {**PLAIN, "draws": np.full((6, 8), 0.5), **changes}
    pixels = np.array(patch, float)
    patch = pixels.reshape(1, 1, 3) if pixels.size == 3 else pixels
    return np.asarray(
        f(image, mask, how["tint"], how["brightness"], how["salt"], how["draws"], patch, corner)
    )


def _is(f: Function, at: tuple[int, int], rgb: tuple[int, int, int], **how: object) -> bool:
    made = _made(f, **how)
    return made.dtype == np.uint8 and made.shape == (6, 8, 3) and made[at].tolist() == list(rgb)


def _keeps_image(f: Function) -> bool:
    image, mask = _picture()
    before = image.copy()
    f(image, mask, np.full(3, 0.5), 1.3, 0.1, np.zeros((6, 8)), np.zeros((2, 2, 3)), (0, 0))
    return bool(np.array_equal(image, before))


BIG = np.full((3, 4, 3), 7.0)
RANDOM_CHECKS = (
    Check(
        "a patch of one pixel at (1, 5) changes that pixel only",
        lambda f: (
            _is(f, (1, 5), (10, 20, 30), corner=(1, 5))
            and _is(f, (5, 1), (100, 150, 200), corner=(1, 5))
        ),
        "Row first, then column.",
    ),
    Check(
        "the leader stays in front of the patch",
        lambda f: (
            _is(f, (2, 3), (100, 150, 200), patch=BIG, corner=(1, 2))
            and _is(f, (1, 3), (7, 7, 7), patch=BIG, corner=(1, 2))
        ),
        "Only pixels outside the mask take the patch.",
    ),
    Check(
        "a patch over the edge is cut off",
        lambda f: (
            _is(f, (5, 7), (7, 7, 7), patch=BIG, corner=(4, 6))
            and _is(f, (3, 7), (100, 150, 200), patch=BIG, corner=(4, 6))
        ),
        "A slice that reaches too far is shorter; make the patch as short.",
    ),
    Check(
        "the tint multiplies red, green and blue of the leader only",
        lambda f: (
            _is(f, (3, 4), (50, 165, 100), tint=np.array([0.5, 1.1, 0.5]))
            and _is(f, (0, 1), (100, 150, 200), tint=np.array([0.5, 1.1, 0.5]))
        ),
        "One factor for each channel, on mask pixels.",
    ),
    Check(
        "salt 0.2: below 0.1 black, above 0.9 white, between unchanged, and on the leader only",
        lambda f: all(
            _is(f, at, rgb, salt=0.2, draws=np.full((6, 8), value))
            for at, rgb, value in (
                ((2, 3), (0, 0, 0), 0.09),
                ((2, 3), (255, 255, 255), 0.91),
                ((2, 3), (100, 150, 200), 0.11),
                ((2, 3), (100, 150, 200), 0.89),
                ((0, 1), (100, 150, 200), 0.01),
                ((0, 1), (100, 150, 200), 0.99),
            )
        ),
        "Half of the share turns black, half white.",
    ),
    Check(
        "twice the light multiplies all numbers by 2 ** (1 / GAMMA) = 1.3703, "
        "rounded and cut at 255",
        lambda f: (
            _is(f, (0, 1), (137, 206, 255), brightness=2.0)
            and _is(f, (2, 3), (137, 206, 255), brightness=2.0)
        ),
        "Gamma; then clip, then round.",
    ),
    Check(
        "the order: white salt in half the light is 255 * 0.5 ** (1 / GAMMA) = 186, "
        "and the tint leaves salt alone",
        lambda f: (
            _is(
                f,
                (2, 3),
                (186, 186, 186),
                salt=0.2,
                draws=np.ones((6, 8)),
                brightness=0.5,
                tint=np.full(3, 0.5),
            )
            and round(255 * 0.5 ** (1 / GAMMA)) == 186
        ),
        "Tint, salt, then light.",
    ),
    Check(
        "the picture that came in stays as it is",
        _keeps_image,
        "astype makes a copy; assignment does not.",
    ),
)

LAB = Lab(
    name="lab09",
    title="Masks and randomisation",
    hours=3.0,
    exercises=(
        Exercise("ellipsoid_mask", 21.0, MASK_CHECKS),
        Exercise("iou", 15.0, IOU_CHECKS),
        Exercise("mask_loss", 20.0, LOSS_CHECKS, through="run_mask_loss", seconds=20.0),
        Exercise("randomize", 19.0, RANDOM_CHECKS),
    ),
    rubric=(
        Criterion(
            "labels",
            5.0,
            "Ellipses sit on the aircraft, inside the rendered outline; the board cuts one off.",
        ),
        Criterion(
            "window",
            5.0,
            "Both networks' outlines on views with and without leader; IoU and false alarms.",
        ),
        Criterion(
            "window_reading",
            5.0,
            "Unseen views and false alarms got better, seen views did not; own numbers.",
        ),
        Criterion(
            "q1",
            3.0,
            "Smaller than the rendered outline, but centred; harmless for steering, "
            "not for measuring.",
        ),
        Criterion(
            "q2",
            3.0,
            "Short cut 'bright and striped'; look-alikes break it without showing the windows.",
        ),
        Criterion(
            "q3",
            4.0,
            "Mask holds no hall; wrong masks go unnoticed; RGB + Mask can detect that; time; "
            "30 flights.",
        ),
    ),
    constants={"pos_weight": (4.0, 12.0, 1), "dice_weight": (0.5, 1.5, 2)},
    packages=("numpy", "torch"),
    memory_mib=2048,
)
