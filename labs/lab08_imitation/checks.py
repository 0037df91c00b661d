"""Lab 8: its exercises, what a student can check, and what a person grades."""

import numpy as np
from given import CLIP_NORM, TURN_WEIGHT

from falconwing_kit.tools.grading import Check, Criterion, Exercise, Function, Lab, is_same_answer

COUNT, TWO = np.arange(1.0, 7.0), np.array([0, 4])  # six commands, two flights: 1 2 3 4 and 5 6
RGB = np.zeros((2, 2, 3, 3), np.uint8)  # two pictures, 2 rows, 3 columns
RGB[0, 0, 0], RGB[0, 1, 2], RGB[1] = (255, 0, 51), (0, 204, 0), 102
PAST, LABELS = np.array([[0.1, 0.2], [0.3, -0.4]]), np.array([0.5, -0.6])


def _pictures(make: Function, mirror: bool = False) -> np.ndarray:
    return np.asarray(make(RGB, PAST, LABELS, mirror)[0], float)


def _pixel(
    make: Function, at: tuple[int, int, int, int], expected: float, mirror: bool = False
) -> bool:
    return is_same_answer(float(_pictures(make, mirror)[at]), expected, 1e-5, 1e-6)


def _step(function: Function, bias: float, labels: list[list[float]], rate: float) -> dict:
    """A network with zero weights but for the last bias, its answer and only gradient."""
    steps, n = np.shape(labels)
    weights = [np.zeros((2, 4)), np.zeros(2), np.zeros((1, 2)), np.array([bias])]
    return function(
        weights, np.zeros((steps, n, 3, 1, 1)), np.zeros((steps, n, 1)), np.array(labels), rate
    )


def _bias(function: Function, bias: float, labels: list[list[float]], rate: float) -> float:
    return float(_step(function, bias, labels, rate)["weights"][3][0])


def _second_step(function: Function) -> bool:
    """Bias 0.1, label 0, no clipping: g = 2 b, so b -> b (1 - 2 rate) each time."""
    return is_same_answer(_bias(function, 0.1, [[0.0], [0.0], [0.0]], 0.25), 0.1 * 0.5**3, 1e-9)


def _clips(function: Function) -> bool:
    """Bias 9, label 0: the gradient 18 is cut to CLIP_NORM."""
    return is_same_answer(_bias(function, 9.0, [[0.0]], 0.5), 9.0 - 0.5 * CLIP_NORM, 1e-4)


def _clips_all_together(function: Function) -> bool:
    """Two weights with gradients in the ratio (h, 1): the step's length is rate * CLIP_NORM."""
    weights = [np.zeros((1, 4)), np.array([1.0]), np.array([[6.0]]), np.array([6.0])]
    after = function(
        weights, np.zeros((1, 1, 3, 1, 1)), np.zeros((1, 1, 1)), np.zeros((1, 1)), 1.0
    )["weights"]
    moved = [np.ravel(a - b) for a, b in zip(after, weights, strict=True)]
    return is_same_answer(float(np.linalg.norm(np.concatenate(moved))), CLIP_NORM, 1e-4)


CALM = np.array([[0.5, 0.0, 0.0, -1.0], [-0.25, 0.0, 0.0, -1.0]])  # offset, yaw, wind, no gusts
STRAIGHT, NONE = np.zeros(3), np.zeros(4)
STEER = np.array([0.3, -1.2, 0.0])


def _spreads(function: Function, *offsets: float) -> dict:
    """Flights straight ahead: they end where they began."""
    return function(STRAIGHT, NONE, np.array([[offset, 0.0, 0.0, -1.0] for offset in offsets]))


def _remembers(function: Function, memory: list[float], same_as: list[float]) -> bool:
    """Whether two implementations of the history give the same flight."""
    flown = [function(STEER, np.array(each), CALM)["offsets"] for each in (memory, same_as)]
    return is_same_answer(flown[0], flown[1], 1e-9, 1e-12)


HISTORY_CHECKS = (
    Check(
        "commands 1 2 3 4 of one flight with k = 2: rows (0,0) (1,0) (2,1) (3,2)",
        lambda f: is_same_answer(
            f(COUNT[:4], TWO[:1], 2), np.array([[0.0, 0], [1, 0], [2, 1], [3, 2]])
        ),
        "Column 0 is one frame before; the frame's own command is not in its row.",
    ),
    Check(
        "a second flight 5 6 starts with an empty history: rows (0,0) (5,0)",
        lambda f: is_same_answer(f(COUNT, TWO, 2)[4:], np.array([[0.0, 0], [5, 0]])),
        "Nothing of the flight before may leak in.",
    ),
    Check(
        "a flight may be shorter than the history, also the first one",
        lambda f: (
            is_same_answer(f(COUNT, TWO, 5)[3], np.array([3.0, 2, 1, 0, 0]))
            and is_same_answer(
                f(COUNT[:3], np.array([0, 1]), 4), np.array([[0.0] * 4, [0] * 4, [2, 0, 0, 0]])
            )
            and is_same_answer(f(COUNT, np.array([0, 2, 4]), 5)[3], np.array([3.0, 0, 0, 0, 0]))
        ),
        "Look out for negative numbers in slices: they count from the end.",
    ),
    Check(
        "the shape is (n, k), for one frame and one column too",
        lambda f: (
            is_same_answer(f(COUNT[:1], TWO[:1], 3), np.zeros((1, 3)))
            and is_same_answer(f(COUNT[:2], TWO[:1], 1), np.array([[0.0], [1]]))
        ),
        "numpy.zeros((n, k)) is a good start.",
    ),
)
DATASET_CHECKS = (
    Check(
        "the shape is (n, 3, H, W), and (2 n, 3, H, W) with the mirror",
        lambda f: _pictures(f).shape == (2, 3, 2, 3) and _pictures(f, True).shape == (4, 3, 2, 3),
        "transpose, not reshape.",
    ),
    Check(
        "255 becomes 1, 0 becomes -1, and 51 becomes -0.6",
        lambda f: (
            _pixel(f, (0, 0, 0, 0), 1.0)
            and _pixel(f, (0, 1, 0, 0), -1.0)
            and _pixel(f, (0, 2, 0, 0), -0.6)
        ),
        "(p - 127.5) / 127.5, in floating point.",
    ),
    Check(
        "rows stay rows, and colours stay colours: the green pixel of the last row and column is "
        "found there",
        lambda f: (
            _pixel(f, (0, 1, 1, 2), 0.6)
            and _pixel(f, (0, 0, 1, 2), -1.0)
            and _pixel(f, (1, 2, 1, 0), -0.2)
        ),
        "Axes in order: picture, colour, row, column.",
    ),
    Check(
        "mirrored pictures come behind the others, with left and right swapped, not top and bottom",
        lambda f: (
            _pixel(f, (0, 0, 0, 0), 1.0, True)
            and _pixel(f, (2, 0, 0, 2), 1.0, True)
            and _pixel(f, (2, 1, 1, 0), 0.6, True)
        ),
        "The last axis is the columns.",
    ),
    Check(
        "mirrored history and labels have the other sign",
        lambda f: (
            is_same_answer(f(RGB, PAST, LABELS, True)[1], np.concatenate([PAST, -PAST]))
            and is_same_answer(f(RGB, PAST, LABELS, True)[2], np.array([0.5, -0.6, -0.5, 0.6]))
        ),
        "A mirrored right turn is a left turn, in the past too.",
    ),
    Check(
        "without the mirror history and labels stay as they are",
        lambda f: (
            is_same_answer(f(RGB, PAST, LABELS, False)[1], PAST)
            and is_same_answer(f(RGB, PAST, LABELS, False)[2], LABELS)
        ),
        "Look at the argument `mirror`.",
    ),
)
LOSS_CHECKS = (
    Check(
        "answer 0.3, label 0: the loss is 0.09",
        lambda f: is_same_answer(_step(f, 0.3, [[0.0]], 0.1)["losses"], np.array([0.09])),
        "The square of the error; flying straight has the weight 1.",
    ),
    Check(
        "answer 0, labels 1 and -1: each weighs 1 + TURN_WEIGHT, and the loss is the mean",
        lambda f: is_same_answer(
            _step(f, 0.0, [[1.0, -1.0]], 0.1)["losses"], np.array([1.0 + TURN_WEIGHT])
        ),
        "The size of the expert's aileron weighs, not its sign; divide by n.",
    ),
    Check(
        "answer 0, labels 0.2 and 0: by hand 0.02 (1 + 0.2 TURN_WEIGHT)",
        lambda f: is_same_answer(
            _step(f, 0.0, [[0.2, 0.0]], 0.1)["losses"], np.array([0.02 * (1.0 + 0.2 * TURN_WEIGHT)])
        ),
        "Weights are not normalised, and they are not squared.",
    ),
    Check(
        "a step goes downhill: answer 0.1, label 0, rate 0.25 gives 0.05",
        lambda f: is_same_answer(_bias(f, 0.1, [[0.0]], 0.25), 0.05),
        "backward, then optimiser.step().",
    ),
    Check(
        "three steps in a row halve the answer three times",
        _second_step,
        "Gradients add up in PyTorch until you forget them.",
    ),
    Check(
        "a gradient of 18 is shortened to CLIP_NORM",
        _clips,
        "clip_grad_norm_ comes between backward and step.",
    ),
    Check(
        "all weights' gradients are shortened together, as one vector",
        _clips_all_together,
        "clip_grad_norm_ with all parameters, not clip_grad_value_, and not one by one.",
    ),
    Check(
        "the loss is the one before the step",
        lambda f: is_same_answer(_step(f, 0.4, [[0.0], [0.0]], 0.25)["losses"][0], 0.16),
        "Return the number that you computed, and do not compute it again.",
    ),
)
LOOP_CHECKS = (
    Check(
        "straight ahead a flight ends where it began: offsets 0.5, -0.25 and 3 m",
        lambda f: is_same_answer(
            _spreads(f, 0.5, -0.25, 3.0)["offsets"], np.array([0.5, -0.25, 3.0])
        ),
        "The offset with its sign, at the end of each flight.",
    ),
    Check(
        "0.9 m to either side is landed, 1.1 m is not",
        lambda f: is_same_answer(
            _spreads(f, 0.9, -0.9, 1.1, -1.1)["landed"], np.array([True, True, False, False])
        ),
        "The absolute offset against PAD_HALF.",
    ),
    Check(
        "success is the share that landed: 1 of 4 is 0.25",
        lambda f: is_same_answer(_spreads(f, 0.4, 2.0, 3.0, -2.0)["success"], 0.25),
        "The mean of booleans is a share.",
    ),
    Check(
        "the mean deviation is over landed flights only: 0.4, -0.6 and a failure at 3 m give 0.5 m",
        lambda f: is_same_answer(_spreads(f, 0.4, -0.6, 3.0)["ald"], 0.5),
        "Absolute values, and failures are neither 0 nor 3.",
    ),
    Check(
        "no landing at all: the mean deviation is nan, and nothing fails",
        lambda f: (
            is_same_answer(_spreads(f, 2.0, -3.0)["ald"], float("nan"))
            and is_same_answer(_spreads(f, 2.0)["success"], 0.0)
        ),
        "Ask landed.any() first.",
    ),
    Check(
        "a flight that turned away is lost, though its offset is small",
        lambda f: is_same_answer(
            f(STRAIGHT, NONE, np.array([[0.3, 1.3, 0.0, -1.0], [0.3, 0.0, 0.0, -1.0]]))["landed"],
            np.array([False, True]),
        ),
        "flight.lost.",
    ),
    Check(
        "the policy gets the picture of this very moment: steering by it brings 0.5 m down to less "
        "than 0.2 m",
        lambda f: bool(np.all(np.abs(f(STEER, NONE, CALM)["offsets"]) < 0.2)),
        "Look anew in every step, then fly.",
    ),
    Check(
        "the first step's history is zeros in every flight: "
        "the same start twice ends twice the same",
        lambda f: bool(
            np.ptp(
                f(STEER, np.array([0.3, 0.2, 0.1, 0.0]), np.repeat(CALM[:1], 3, axis=0))["offsets"]
            )
            == 0.0
        ),
        "A new flight needs a new history.",
    ),
    Check(
        "the newest command comes first: steering by offset less the oldest of four commands, "
        "written out by hand",
        lambda f: is_same_answer(
            f(
                np.array([1.0, 0.0, 0.0]),
                np.array([0.0, 0.0, 0.0, -1.0]),
                np.array([[0.1, 0.0, 0.0, -1.0]]),
            )["offsets"],
            _by_hand(),
            1e-9,
        ),
        "history = newest, then the older ones; the oldest falls out.",
    ),
    Check(
        "the history holds what was flown, cut to -1..1",
        lambda f: is_same_answer(
            f(np.array([8.0, -60.0, 0.0]), np.array([-0.5, 0.0, 0.0, 0.0]), CALM[:1])["offsets"],
            _by_hand(8.0, -60.0, (-0.5, 0.0, 0.0, 0.0), 0.5),
            1e-9,
        ),
        "Cut first, then fly and remember.",
    ),
)


def _by_hand(
    gain: float = 1.0,
    yaw_gain: float = 0.0,
    memory: tuple[float, ...] = (0.0, 0.0, 0.0, -1.0),
    offset: float = 0.1,
) -> np.ndarray:
    """The same flight written out: u = gain * offset + yaw_gain * yaw + memory .

    (u_1 u_2 u_3 u_4), cut to -1..1.
    """
    x, yaw, roll, flown = -17.0, 0.0, 0.0, [0.0] * len(memory)
    while x < 4.5 and abs(offset) <= 6.0 and abs(yaw) <= 1.2:
        aileron = (
            gain * offset + yaw_gain * yaw + sum(m * flown[-1 - i] for i, m in enumerate(memory))
        )
        aileron = min(max(aileron, -1.0), 1.0)
        flown.append(aileron)
        roll += 0.05 / 0.25 * (np.radians(35.0) * aileron - roll)
        yaw += 0.05 * 9.81 / 7.0 * np.tan(roll)
        x, offset = x + 0.35 * np.cos(yaw), offset - 0.35 * np.sin(yaw)
    return np.array([offset])


LAB = Lab(
    name="lab08",
    title="Imitation and drift",
    hours=4.0,
    exercises=(
        Exercise("history_window", 16.0, HISTORY_CHECKS),
        Exercise("make_dataset", 16.0, DATASET_CHECKS),
        Exercise("bc_loss_step", 21.0, LOSS_CHECKS, through="run_bc_steps", seconds=20.0),
        Exercise("closed_loop_eval", 22.0, LOOP_CHECKS, through="run_closed_loop"),
    ),
    rubric=(
        Criterion(
            "loss",
            3.0,
            "Four curves on a logarithmic axis; the clean pilot's held-out loss ends lower.",
        ),
        Criterion(
            "loss_reading",
            2.0,
            "The clean pilot's loss is several times lower, on clean frames only.",
        ),
        Criterion(
            "drift", 6.0, "Three panels of twenty tracks; landings and failures marked and counted."
        ),
        Criterion(
            "drift_reading",
            4.0,
            "The clean pilot drifts off though its loss is lower; the noisy one comes back. "
            "Counts.",
        ),
        Criterion(
            "q1",
            4.0,
            "Different frames in closed loop (covariate shift); errors feed on themselves.",
        ),
        Criterion(
            "q2", 3.0, "Copying the last command; noise separates the flown command from the label."
        ),
        Criterion(
            "q3", 3.0, "Pairs the flights or gives intervals; 20 flights and one seed are few."
        ),
    ),
    constants={"turn_weight": (2.0, 6.0, 1), "clip_norm": (0.5, 1.5, 2)},
    packages=("numpy", "torch"),
    memory_mib=2048,
)
