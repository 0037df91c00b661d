"""Lab 12, public: claims about maps, terms, evidence, verdicts and findings."""

import math
from collections.abc import Mapping
from functools import partial
from typing import Any

import numpy as np
from given import CANDIDATES, CAUTION, CUSHION_M

from falconwing_kit.tools.grading import Check, Criterion, Exercise, Function, Lab, is_close

Array = np.ndarray
NAN = math.nan


_near = partial(is_close, rtol=1e-7)


AT, CALM_AT, EDGES = (
    np.array([0.0, 0.5, 1.0, 2.0, 2.5]),
    np.array([0.1, 0.2, 1.5, 1.6]),
    np.array([0.0, 1.0, 2.0]),
)
RESIDUAL = np.array([[1.0, 1.0], [3.0, NAN], [2.0, 0.0], [4.0, 2.0], [100.0, 100.0]])
CALM = np.array([[1.0, 2.0], [1.0, 2.0], [2.0, 1.0], [2.0, 1.0]])

RESIDUAL_MAP = (
    Check(
        "squares 1, 9 | 4, 16 against the baseline's 1, 1 | 4, 4: the excess is 4 and 6",
        lambda f: _near(f(RESIDUAL[:, :1], AT, CALM[:, :1], CALM_AT, EDGES, 1), [[4.0, 6.0]]),
        "An inner edge belongs to the bin above, the last edge to the last bin, "
        "values outside to none.",
    ),
    Check(
        "a missing value is left out of its channel only",
        lambda f: _near(f(RESIDUAL, AT, CALM, CALM_AT, EDGES, 1), [[4.0, 6.0], [-3.0, 1.0]]),
        "Channels are rows of the answer; an excess may be negative: "
        "the flight was better than the baseline.",
    ),
    Check(
        "a bin with fewer values than `fewest` is nan, on whichever flight they are missing",
        lambda f: (
            _near(f(RESIDUAL, AT, CALM, CALM_AT, EDGES, 2), [[4.0, 6.0], [NAN, 1.0]])
            and _near(
                f(
                    np.repeat(RESIDUAL[:, :1], 2, 0),
                    np.repeat(AT, 2),
                    CALM[:, :1],
                    CALM_AT,
                    EDGES,
                    3,
                ),
                [[NAN, NAN]],
            )
        ),
        "Count measured values of this channel in this bin: exactly `fewest` are enough.",
    ),
)

FLOW = {
    "V": 7.0,
    "alpha": 0.1,
    "beta": 0.2,
    "height": CUSHION_M,
    "c": 0.2,
    "thrust": 3.0,
    "aileron": 0.5,
}
NUMBERS = {"cD_induced": 0.2, "L_da": 0.75}
BEFORE = np.arange(12.0).reshape(6, 2) - 4.0
PATH = np.array([math.cos(0.1) * math.cos(0.2), math.sin(0.2), math.sin(0.1) * math.cos(0.2)])
LIFT = np.array([math.sin(0.1), 0.0, -math.cos(0.1)])


def _added(f: Function, effect: str, size: float, **other: float) -> Array:
    """What an effect adds at FLOW, the same in both columns."""
    flow = {name: np.full(2, value) for name, value in {**FLOW, **other}.items()}
    more = np.asarray(f(BEFORE.copy(), flow, dict(NUMBERS), effect, size)) - BEFORE
    return more[:, 0] if np.allclose(more[:, 0], more[:, 1]) else np.full(6, NAN)


def _expected(force: Any = (0.0, 0.0, 0.0), moment: Any = (0.0, 0.0, 0.0)) -> Array:
    return np.concatenate([np.asarray(force, float), np.asarray(moment, float)])


AUGMENT = (
    Check(
        "nothing is added for none, and nothing at size zero",
        lambda f: (
            _near(_added(f, "none", 0.3), np.zeros(6))
            and _near(_added(f, "ground_effect", 0.0), np.zeros(6))
        ),
        "Add to the loads that came in, do not replace them.",
    ),
    Check(
        "a drag of 0.01 / m brakes 0.49 m/s^2 at 7 m/s, against the path",
        lambda f: _near(_added(f, "extra_drag", 0.01), _expected(-0.49 * PATH)),
        "V squared, and three components: the path has a part along y in a sideslip.",
    ),
    Check(
        "30 % less of 3 m/s^2 of thrust is -0.9 along the nose",
        lambda f: _near(_added(f, "thrust_loss", 0.3), _expected((-0.9, 0.0, 0.0))),
        "thrust in flow is the whole thrust at this throttle and speed.",
    ),
    Check(
        "ground effect of 0.4 half a metre up: 0.4 / e of the lift more, "
        "and of the induced drag less",
        lambda f: _near(
            _added(f, "ground_effect", 0.4),
            _expected(0.4 / math.e * 49.0 * (0.2 * LIFT + 0.008 * PATH)),
        ),
        "Induced drag is V^2 cD_induced c^2; less of it pushes forward along the path.",
    ),
    Check(
        "the cushion is whole at the floor and gone at five metres",
        lambda f: (
            _near(
                _added(f, "ground_effect", 0.4, height=0.0),
                math.e * _added(f, "ground_effect", 0.4),
            )
            and np.abs(_added(f, "ground_effect", 0.4, height=5.0)).max() < 1e-3
        ),
        "exp(-h / CUSHION_M): it fades with height.",
    ),
    Check(
        "aileron lost: a rolling moment against the aileron's own",
        lambda f: _near(
            _added(f, "aileron_loss", 0.3), _expected(moment=(-0.3 * 49.0 * 0.75 * 0.5, 0.0, 0.0))
        ),
        "It is a share of V^2 L_da aileron; loads[3] is the rolling moment.",
    ),
    Check(
        "adverse yaw: right aileron turns the nose to the left",
        lambda f: _near(
            _added(f, "adverse_yaw", 0.1), _expected(moment=(0.0, 0.0, -0.1 * 49.0 * 0.5))
        ),
        "loads[5] is the yawing moment, positive nose right.",
    ),
)

M = 8
NO_NUMBERS, UNKNOWN = (np.zeros((M, 1)), np.zeros(1), np.eye(1)), np.full((1, 1), 1e-12)
UNIT = np.eye(M)
R = np.array([3.0, -4.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0])


def _score(
    f: Function,
    J: Array,
    away: Array,
    precision: Array,
    E: Array,
    scatter: float = 1.0,
    r: Array = R,
) -> Array:
    """The answer for one candidate."""
    answer: Mapping[str, Any] = f(r, J, away, precision, {"it": E}, scatter)
    return np.asarray(answer["it"]) if set(answer) == {"it"} else np.zeros(0)


def _tight(f: Function) -> bool:
    """J = E = e0, r0 = 3, P = 1: dK = -1.5 leaves a cost of 4.5, the candidate alone makes it 0.

    The same turned.
    """
    turned = np.array(
        [[0.5, 0.2], [0.2, 0.9]]
    )  # two that go together: 0.5 - 0.2^2 / 0.9 is left for the first
    return _near(
        _score(f, UNIT[:, :1], np.zeros(1), np.eye(1), UNIT[:, :1]), [4.5 - math.log(M), -3.0]
    ) and _near(
        _score(f, np.column_stack([UNIT[:, 0], 0.0 * R]), np.zeros(2), turned, UNIT[:, :1])[0],
        9.0 / (1.0 + 1.0 / (0.5 - 0.04 / 0.9)) - math.log(M),
    )


SCORE = (
    Check(
        "one number that explains a residual of 3: gain 9 - ln 8, size -3",
        lambda f: _near(_score(f, *NO_NUMBERS, UNIT[:, :1]), [9.0 - math.log(M), -3.0]),
        "The size makes the residual vanish, so it has the other sign. "
        "M is the number of residuals.",
    ),
    Check(
        "two numbers cost twice the penalty",
        lambda f: _near(_score(f, *NO_NUMBERS, UNIT[:, :2]), [25.0 - 2.0 * math.log(M), -3.0, 4.0]),
        "The price is ln M for each column of the candidate.",
    ),
    Check(
        "where the noise is stronger the same chi2 is less evidence; the price stays",
        lambda f: _near(_score(f, *NO_NUMBERS, UNIT[:, :1], 2.0), [4.5 - math.log(M), -3.0]),
        "Divide the gained chi2 by the scatter, then subtract the price.",
    ),
    Check(
        "what the aircraft's own free parameters explain is no evidence",
        lambda f: _near(
            _score(f, UNIT[:, :1], np.zeros(1), UNKNOWN, UNIT[:, [1]])[0], 16.0 - math.log(M)
        ),
        "Compare with the best fit *without* the candidate, "
        "in which the parameters K are free too.",
    ),
    Check(
        "a prior of precision 1 lets them explain half of it",
        _tight,
        "The prior adds P to the matrix.",
    ),
    Check(
        "parameters that drifted away from the prior are pulled back by it",
        lambda f: (
            _near(
                _score(f, UNIT[:, :1], np.full(1, 3.0), np.eye(1), UNIT[:, [1]]),
                [16.0 - math.log(M), 4.0],
            )
            and _near(
                _score(f, UNIT[:, :1], np.full(1, -1.0), np.full((1, 1), 4.0), UNIT[:, :1]),
                [12.8 - math.log(M), -4.0],
            )
        ),
        "The prior's cost is (away + dK)' P (away + dK): half of its gradient at the fit is P "
        "away.",
    ),
)

QUIET = np.array([-4.0, -2.0, -3.0])
LOUD = np.array([-4.0, 20.0, 3.0])

VERDICT = (
    Check(
        "nothing above 10: none",
        lambda f: tuple(f({"wind": 9.0, "extra_drag": -3.0}, QUIET)) == (10.0, "none", ()),
        "Return threshold, word, names; LEAST_GAIN is the smallest threshold.",
    ),
    Check(
        "one far ahead: named",
        lambda f: (
            tuple(f({"extra_drag": 40.0, "wind": 300.0, "mass_change": -3.0}, QUIET))
            == (10.0, "named", ("wind",))
        ),
        "Names are a tuple, also if there is only one.",
    ),
    Check(
        "what chance finds raises the threshold",
        lambda f: (
            _near(f({"wind": 45.0, "extra_drag": 1.0}, LOUD)[0], 20.0 * CAUTION)
            and f({"wind": 45.0, "extra_drag": 1.0}, LOUD)[1] == "none"
            and f({"wind": 90.0, "extra_drag": 1.0}, LOUD)[1] == "named"
        ),
        "The largest of the calm gains, times CAUTION.",
    ),
    Check(
        "three within 10 of the best: ambiguous, best first",
        lambda f: (
            tuple(f({"a": 92.0, "b": 50.0, "c": 99.0, "d": 90.5}, QUIET))
            == (10.0, "ambiguous", ("c", "a", "d"))
        ),
        "Sort by the gain, largest first; take those that are less than LEAST_GAIN behind the "
        "best.",
    ),
)


def _in_order(f: Function) -> bool:
    found = f()
    low, size, high = found["low"], found["size"], found["high"]
    if found["effect"] == "none":
        return bool(low == size == high == 0.0)
    return bool(low < size < high and low * high > 0.0)


def _sensible(f: Function) -> bool:
    found = f()
    if found["effect"] == "none":
        return True
    size, half = abs(found["size"]), 0.5 * (found["high"] - found["low"])
    return bool(size <= CANDIDATES[found["effect"]].largest and half <= 0.4 * size)


FINDING = (
    Check(
        "the answer has an effect of the list (or none), a size, a low and a high end",
        lambda f: (
            set(f()) == {"effect", "size", "low", "high"} and f()["effect"] in {"none", *CANDIDATES}
        ),
        "A dict with these four names; the effect is written as in CANDIDATES.",
    ),
    Check(
        "low, size and high are in order and do not include zero; for none all are zero",
        _in_order,
        "If the interval reaches over zero, the effect may be absent: then say none.",
    ),
    Check(
        "the size makes sense in the unit given in CANDIDATES, and is known to 40 %",
        _sensible,
        "Shares are numbers from 0 to 1, times are in seconds. "
        "Is the interval half as wide as the size?",
    ),
)

ROUND = np.radians([0.0, 90.0, 180.0, 270.0])
NOSE = np.array([[1.0, 0.0], [0.0, -1.0], [-1.0, 0.0], [0.0, 1.0]])  # yaw to the right, y left
RIGHT = np.array([[0.0, -1.0], [-1.0, 0.0], [0.0, 1.0], [1.0, 0.0]])

WIND = (
    Check(
        "5 m/s along the nose on four headings, in air at rest",
        lambda f: _near(f(5.0 * NOSE, ROUND), [5.0, 0.0, 0.0, 0.0]),
        "At 90 deg of yaw the nose points to minus y: yaw is positive to the right, y to the left.",
    ),
    Check(
        "1 m/s to the right wing besides",
        lambda f: _near(f(5.0 * NOSE + RIGHT, ROUND), [5.0, 1.0, 0.0, 0.0]),
        "At yaw zero the right wing points to minus y.",
    ),
    Check(
        "air that moves by (0.4, -0.3) m/s is added to every velocity and found again (Galilei)",
        lambda f: _near(
            f(5.0 * NOSE + RIGHT + np.array([0.4, -0.3]), ROUND), [5.0, 1.0, 0.4, -0.3]
        ),
        "The wind has a column of its own for each axis: ones there, zeros in the other's rows.",
    ),
    Check(
        "uneven headings do not shift it: three rows to the east for one to the west",
        lambda f: _near(
            f((5.0 * NOSE + np.array([0.4, -0.3]))[[0, 0, 0, 1, 2]], ROUND[[0, 0, 0, 1, 2]]),
            [5.0, 0.0, 0.4, -0.3],
        ),
        "The mean velocity is no wind: solve for all four numbers together.",
    ),
    Check(
        "an error of 0.4 m/s in one of four rows: a quarter of it in a and in the wind",
        lambda f: _near(
            f(5.0 * NOSE + np.array([[0.4, 0.0], [0, 0], [0, 0], [0, 0]]), ROUND),
            [5.1, 0.0, 0.1, 0.0],
        ),
        "Least squares over all rows, each with the same weight.",
    ),
    Check(
        "a row in which one component is missing does not count",
        lambda f: _near(
            f(np.concatenate([5.0 * NOSE, [[NAN, 7.0]]]), np.append(ROUND, 0.3)),
            [5.0, 0.0, 0.0, 0.0],
        ),
        "Keep the rows whose vx and vy are both finite.",
    ),
)

LAB = Lab(
    name="lab12",
    title="What is missing in the model?",
    hours=4.5,
    notebook_since="0.2",  # the model's symbols are the textbook's since then
    exercises=(
        Exercise("residual_map", 13.0, RESIDUAL_MAP),
        Exercise("augment_model", 13.0, AUGMENT),
        Exercise("score_candidates", 17.0, SCORE),
        Exercise("verdict", 8.0, VERDICT),
        Exercise("my_finding", 14.0, FINDING),
        Exercise("estimate_wind", 10.0, WIND),
    ),
    rubric=(
        Criterion("map", 3.0, "Map drawn: four variables, six channels, a scale."),
        Criterion(
            "map_reading",
            3.0,
            "Points at the cells that stand out (or states that none does), and guesses.",
        ),
        Criterion("gap", 3.0, "Evidence with the threshold and gap drawn; after is near calm."),
        Criterion(
            "gap_reading",
            2.0,
            "Passed and closed, or a 'none' defended by the threshold; bending has a cost.",
        ),
        Criterion("real", 2.0, "Two rings of one size; the second centre lies at the hidden wind."),
        Criterion(
            "real_reading",
            2.0,
            "Interval against the truth; the same error in both parts cancels; one heading cannot "
            "separate speed from wind; drag or mass would have changed the path.",
        ),
        Criterion("q1", 5.0, "One rival with a similar map, and what separates them."),
        Criterion(
            "q2",
            5.0,
            "Numbers that imitate an effect swallow it; the largest of many gains is never zero.",
        ),
    ),
    constants={"caution": (2.5, 3.5, 1)},
)
