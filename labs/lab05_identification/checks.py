"""Lab 5, public: claims about residuals, steps, intervals and scores that a student can run."""

import math

import numpy as np
from given import FAR, GRAVITY, GUESS, PRIOR_SIGMA, SIGMA, Z, step

from falconwing_kit.tools.grading import Check, Criterion, Exercise, Function, Lab, is_close

Array = np.ndarray
NAN = math.nan


T = np.array([0.0, 0.1, 0.2, 0.3, 0.5, 0.6])  # a frame at 0.4 s is missing altogether

LOCAL_SLOPE = (
    Check(
        "a straight line has its own slope everywhere, also at the ends and at uneven times",
        lambda f: is_close(f(T, 3.0 - 2.0 * T, 2)[0], np.full(6, -2.0)),
        "At the ends there are fewer rows: take those that exist. tau counts from their mean time, "
        "not from row k.",
    ),
    Check(
        "one row to each side of x = t^2: 0.4 in the middle of 0.1, 0.2, 0.3 s, "
        "5/7 where a frame is missing",
        lambda f: is_close(f(T, T**2, 1)[0], [0.1, 0.2, 0.4, 5.0 / 7.0, 31.0 / 35.0, 1.1]),
        "half counts rows to each side, so three in the middle; "
        "tau is the time less the mean of these times.",
    ),
    Check(
        "three rows 0.1 s apart pass 1 / (0.1 sqrt 2) = 7.07 of the noise per second, "
        "two rows 14.1",
        lambda f: is_close(
            f(T, T, 1)[1][:3], [10.0 * math.sqrt(2.0), 5.0 * math.sqrt(2.0), 5.0 * math.sqrt(2.0)]
        ),
        "The noise is 1 / sqrt(sum tau^2).",
    ),
    Check(
        "a missing value is left out, and a row alone has no slope",
        lambda f: is_close(
            f(T, np.array([1.0, NAN, 3.0, NAN, NAN, NAN]), 1)[0], [NAN, 10.0, NAN, NAN, NAN, NAN]
        ),
        "Keep the rows whose x is finite; from fewer than two of them there is no slope.",
    ),
    Check(
        "where a neighbour is missing, tau is taken from the rows that are left",
        lambda f: is_close(
            [part[2] for part in f(T, np.array([0.0, NAN, 0.4, 0.5, 0.9, 1.0]), 2)],
            [23.0 / 13.0, 1.0 / math.sqrt(0.13)],
        ),
        "Leave missing rows out before you take the mean of the times.",
    ),
)


def _frames(e: Array) -> tuple[Array, Array, Array]:
    """Predicted, measured and sigma such that the residual in sigmas is e; measured is not zero."""
    measured = np.broadcast_to(np.array([2.0, 1.5, 0.1]), e.shape)
    return measured + np.nan_to_num(e) * SIGMA, np.where(np.isfinite(e), measured, NAN), SIGMA


SMALL = np.array([[[0.5, -1.0, 1.5]], [[-0.3, 0.2, 0.0]]])
FAR_OFF = np.array([[[0.5, -4.0 * FAR, 2.0 * FAR], [1.0, 0.0, -1.0]]])
MISSING = np.array([[[0.5, NAN, 1.0], [1.0, 0.5, -1.0]]])


def _left_alone(f: Function) -> bool:
    predicted, measured, sigma = (part.copy() for part in _frames(MISSING))
    kept = predicted.copy(), measured.copy()
    f(predicted, measured, sigma)
    return np.array_equal(predicted, kept[0]) and np.array_equal(measured, kept[1], equal_nan=True)


RESIDUALS = (
    Check(
        "small residuals are predicted minus measured, in sigmas, with weight 1 / sigma",
        lambda f: (
            is_close(f(*_frames(SMALL))[0], SMALL)
            and is_close(f(*_frames(SMALL))[1], np.ones((2, 1, 3)) / SIGMA)
        ),
        "Check the sign, and that each channel has a sigma of its own. Return r and weight.",
    ),
    Check(
        "a channel four times FAR away halves the whole frame, and only that frame",
        lambda f: is_close(f(*_frames(FAR_OFF))[0], FAR_OFF * np.array([[[0.5], [1.0]]])),
        "The factor is sqrt(FAR / |e|) where |e| is beyond FAR; "
        "a frame takes the smallest of its three.",
    ),
    Check(
        "the weight carries the same factor",
        lambda f: is_close(f(*_frames(FAR_OFF))[1], np.array([[[0.5] * 3, [1.0] * 3]]) / SIGMA),
        "weight = factor / sigma.",
    ),
    Check(
        "a frame with one missing value counts zero in all channels; its neighbour as ever",
        lambda f: (
            is_close(f(*_frames(MISSING))[0], np.array([[[0.0, 0.0, 0.0], [1.0, 0.5, -1.0]]]))
            and is_close(f(*_frames(MISSING))[1][0, 0], np.zeros(3))
        ),
        "0 times nan is nan: replace first, np.where helps. The weight is zero there too.",
    ),
    Check(
        "what comes in is left as it was",
        _left_alone,
        "measured[...] = 0 changes the caller's array.",
    ),
)


def _problem(W: int = 4, R: int = 9, P: int = 2, n: int = 3) -> tuple[Array, ...]:
    """A small linear problem."""
    rng = np.random.default_rng(1)
    return rng.normal(size=(W, R)), rng.normal(size=(W, R, P)), rng.normal(size=(W, R, n))


def _recovers(f: Function) -> bool:
    """Residuals that a known step makes are taken back exactly by its opposite."""
    _, J_K, J_start = _problem()
    K, starts = np.array([0.7, -1.2]), np.arange(12.0).reshape(4, 3) - 5.0
    r = J_K @ K + np.einsum("wrn,wn->wr", J_start, starts)
    dK, dstart = f(r, J_K, J_start, np.zeros(2), np.full(2, 1e6))
    return is_close(dK, -K, 1e-6) and is_close(dstart, -starts, 1e-6)


def _smallest(f: Function) -> bool:
    """At the minimum the gradient to every unknown is zero, the prior's share included."""
    r, J_K, J_start = _problem()
    away, sigma = np.array([0.4, -0.3]), np.array([0.5, 0.2])
    dK, dstart = f(r, J_K, J_start, away, sigma)
    left = r + J_K @ dK + np.einsum("wrn,wn->wr", J_start, dstart)
    to_K = np.einsum("wrp,wr->p", J_K, left) + (away + dK) / sigma**2
    return is_close(to_K, np.zeros(2)) and is_close(
        np.einsum("wrn,wr->wn", J_start, left), np.zeros((4, 3))
    )


GAUSS_NEWTON = (
    Check(
        "residuals that a step in K and the starts made are taken back exactly",
        _recovers,
        "The step is added, so it points against the residuals. Shapes: dK (P,), dstart (W, n).",
    ),
    Check(
        "after the step no unknown can make the sum of squares smaller, the prior counted",
        _smallest,
        "The prior adds 1 / sigma^2 to the diagonal and away / sigma^2 to the gradient.",
    ),
    Check(
        "a prior of zero width takes K back to it in one step",
        lambda f: is_close(
            f(*_problem(), np.array([0.4, -0.3]), np.full(2, 1e-7))[0], [-0.4, 0.3], 1e-6
        ),
        "away is the present K minus the one known beforehand: which sign does the step have?",
    ),
)

LINE = np.stack(
    [np.ones(6), np.arange(6.0) - 2.5], axis=1
)  # columns at right angles: sums of squares 6 and 17.5


def _half(f: Function, *arguments: object) -> Array:
    """Half the width of each interval in units of Z."""
    ends = np.asarray(f(*arguments))
    return 0.5 * (ends[:, 1] - ends[:, 0]) / Z


K0, R0 = np.array([5.0, -1.0]), np.array([1.0, -1.0, 1.0, 1.0, -1.0, -1.0])

INTERVALS = (
    Check(
        "each interval lies around its number, low end first",
        lambda f: (
            is_close(np.mean(f(K0, R0, LINE, 6, 0), axis=1), K0)
            and np.diff(f(K0, R0, LINE, 6, 0)).min() > 0
        ),
        "Return (P, 2): K minus and plus something.",
    ),
    Check(
        "six residuals of size 1, two numbers: s^2 = 6/4, half widths Z sqrt(1.5/6) and Z "
        "sqrt(1.5/17.5)",
        lambda f: is_close(
            _half(f, K0, R0, LINE, 6, 0), [math.sqrt(1.5 / 6.0), math.sqrt(1.5 / 17.5)]
        ),
        "s^2 is for 6 measured less 2 unknowns; the diagonal of s^2 inv(J'J) holds variances, "
        "not standard deviations.",
    ),
    Check(
        "initial states cost degrees of freedom, and missing numbers were not measured",
        lambda f: (
            is_close(_half(f, K0, R0, LINE, 6, 1)[0], math.sqrt(2.0 / 6.0))
            and is_close(
                _half(
                    f,
                    K0,
                    np.append(R0, [0.0, 0.0]),
                    np.append(LINE, [[0, 0], [0, 0]], axis=0),
                    6,
                    0,
                )[0],
                0.5,
            )
        ),
        "Freedom is measured_count less all unknowns; do not count the rows of r.",
    ),
    Check(
        "correlated parameters have wider intervals than each would have alone",
        lambda f: is_close(
            _half(f, K0, R0, LINE @ np.array([[1.0, 1.0], [0.0, 1.0]]), 6, 0)[0],
            math.sqrt(1.5 / 6.0 + 1.5 / 17.5),
        ),
        "Invert the whole matrix J'J, then take the diagonal.",
    ),
)

ERROR = np.zeros((3, 2, 3))
ERROR[1] = [[0.3, 0.4, 0.02], [0.0, 0.0, 0.0]]
ERROR[2] = [[-0.6, 0.8, -0.01], [0.0, 1.0, 0.03]]
BASE = np.arange(18.0).reshape(3, 2, 3)
HOLED = np.where(
    np.arange(18).reshape(3, 2, 3) == 14, NAN, BASE
)  # the pitch of frame 0 of window 2

HOLDOUT = (
    Check(
        "one window held out: errors of 0.5 m and 0 m make 0.354 m; 0.02 rad and 0 make 0.81 deg",
        lambda f: is_close(
            f(BASE + ERROR, BASE, np.array([0, 1, 2]), np.array([1])),
            [math.sqrt(0.125), math.degrees(math.sqrt(0.0002))],
        ),
        "The position error is a distance; take the root last; return the pitch in degrees.",
    ),
    Check(
        "only windows of passes that were held out count, and a pass may have several windows",
        lambda f: is_close(
            f(BASE + ERROR, BASE, np.array([7, 4, 4]), np.array([4, 9]))[0],
            math.sqrt((0.25 + 1 + 1) / 4),
        ),
        "of_pass is the pass that each window was cut from; np.isin helps.",
    ),
    Check(
        "a frame with a missing pitch does not count for the position either",
        lambda f: is_close(
            f(BASE + ERROR, HOLED, np.array([0, 1, 2]), np.array([2])), [1.0, math.degrees(0.03)]
        ),
        "Keep the frames whose three values are all finite, then take the mean.",
    ),
)

# At V = GRAVITY / 2 and 45 deg the yaw rate is 2 rad/s and the circle's radius V / 2.
SPEED = 0.5 * GRAVITY
RADIUS = 0.5 * SPEED
STEEP = math.radians(45.0)


def _turn(
    f: Function,
    roll: float,
    horizon: float,
    v: tuple[float, ...] = (SPEED, 0.0, 0.0),
    p: tuple[float, ...] = (0.0, 0.0, 0.0),
) -> tuple[Array, float]:
    """One forecast: position (3,) and yaw."""
    later, turned = f(np.array([p]), np.array([v]), np.array([roll]), np.array([horizon]))
    return np.asarray(later)[0], float(np.asarray(turned)[0])


TURN = (
    Check(
        "wings level: straight on and up with the velocity, and the yaw stays",
        lambda f: (
            is_close(_turn(f, 0.0, 2.0, (3.0, -1.0, 0.5), (1.0, 2.0, 3.0))[0], [7.0, 0.0, 4.0])
            and is_close(_turn(f, 0.0, 2.0, (3.0, -1.0, 0.5))[1], 0.0)
        ),
        "At roll zero the turn is zero: np.sinc divides for you. p is where it starts.",
    ),
    Check(
        "45 deg of bank at g/2 m/s: 2 rad/s; after pi/4 s a quarter circle to the right of g/4 m",
        lambda f: (
            is_close(_turn(f, STEEP, math.pi / 4.0)[0], [RADIUS, -RADIUS, 0.0])
            and is_close(_turn(f, STEEP, math.pi / 4.0)[1], math.pi / 2.0)
        ),
        "Right is minus y, while the yaw grows. The chord points where the aircraft flies midway.",
    ),
    Check(
        "after a whole circle it is back, 2 pi further in yaw and higher by its climb",
        lambda f: (
            is_close(_turn(f, STEEP, math.pi, (0.0, SPEED, 0.3))[0], [0.0, 0.0, 0.3 * math.pi])
            and is_close(_turn(f, STEEP, math.pi)[1], 2.0 * math.pi)
        ),
        "Half a turn's sine over half a turn: np.sinc(turned / (2 pi)). Do not wrap the yaw.",
    ),
    Check(
        "a left turn is the mirror image of a right one",
        lambda f: (
            is_close(_turn(f, -0.4, 1.5)[0] * np.array([1.0, -1.0, 1.0]), _turn(f, 0.4, 1.5)[0])
            and is_close(_turn(f, -0.4, 1.5)[1], -_turn(f, 0.4, 1.5)[1])
        ),
        "tan(roll) has the roll's sign; take it along.",
    ),
    Check(
        "the speed of the turn is that over the floor: climbing does not change it",
        lambda f: is_close(_turn(f, STEEP, 1.0, (SPEED, 0.0, 2.0))[1], _turn(f, STEEP, 1.0)[1]),
        "V is the length of (vx, vy).",
    ),
)

LINK = np.array([0.03, 0.02, 0.01, 0.1, 0.06])  # of the links below: m, m, rad, m/s, m/s


def _flights(
    passes: int, rows: int, off: float = 0.0, noise: float = 1.0, seed: int = 4
) -> tuple[Array, Array, Array]:
    """States (P, R, 5), poses and commands of flights; K is `off` of its prior beside GUESS."""
    rng = np.random.default_rng(seed)
    K = GUESS + off * PRIOR_SIGMA * np.array([1, -1, 1, -1, 1, -1, 1, -1])
    commands = np.array([0.6, 0.1]) + rng.uniform(-0.3, 0.3, (passes, rows, 2))
    x = np.array([-8.0, 2.0, 0.13, 7.0, 0.0])[:, None] + np.zeros((5, passes))
    x = x + np.array([1.0, 0.3, 0.03, 0.4, 0.2])[:, None] * rng.normal(size=(5, passes))
    states = [x]
    for k in range(rows - 1):
        states.append(step(states[-1], commands[:, k].T, K))
    flown = np.stack(states).transpose(2, 0, 1)
    return flown, flown[..., :3] + noise * SIGMA * rng.normal(size=(passes, rows, 3)), commands


def _sum_of_squares(
    K: Array, nodes: Array, poses: Array, commands: Array, steps: int, link: Array
) -> float:
    """S, row by row."""
    total = float(np.sum(((K - GUESS) / PRIOR_SIGMA) ** 2))
    for one, rows, acting in zip(nodes, poses, commands, strict=True):
        x = one[0]
        for k, row in enumerate(rows):
            if k:
                x = step(x, acting[k - 1], K)
            if k and k % steps == 0:
                total += float(np.sum(((x - one[k // steps]) / link) ** 2))
                x = one[k // steps]
            if np.isfinite(row).all():
                total += float(np.sum(((x[:3] - row) / SIGMA) ** 2))
    return total


def _nothing_smaller(f: Function, poses: Array, commands: Array, steps: int, link: Array) -> bool:
    """Whether no single unknown, moved alone, could make S smaller by more than 1e-4."""
    K, nodes = (np.asarray(part, float) for part in f(poses, commands, steps, link))
    if K.shape != (8,) or nodes.shape != (len(poses), (poses.shape[1] - 1) // steps + 1, 5):
        return False
    z = np.concatenate([K, nodes.ravel()])

    def total(moved: Array) -> float:
        return _sum_of_squares(
            moved[:8], moved[8:].reshape(nodes.shape), poses, commands, steps, link
        )

    sizes = 0.005 * np.concatenate([PRIOR_SIGMA, np.tile(link, nodes.size // 5)])
    here = total(z)
    for way in np.diag(sizes):
        up, down = total(z + way), total(z - way)
        slope, bend = 0.5 * (up - down), 0.5 * (up + down) - here
        if not (bend > 0.0 and slope**2 / (4.0 * bend) < 1e-4):
            return False
    return math.isfinite(here)


def _smallest_sum(
    f: Function, passes: int, rows: int, steps: int, tight: float = 1.0, off: float = 0.3
) -> bool:
    _, poses, commands = _flights(passes, rows, off)
    return _nothing_smaller(f, poses, commands, steps, tight * LINK)


def _flight_of_the_guess(f: Function) -> bool:
    """By law: without noise S is zero at the guess and the flown states, and nowhere else."""
    flown, poses, commands = _flights(2, 13, noise=0.0)
    K, nodes = f(poses, commands, 4, LINK)
    return is_close(K, GUESS, 1e-4, 1e-5) and is_close(nodes, flown[:, ::4], 1e-4, 1e-4)


def _rows_that_do_not_count(f: Function) -> bool:
    """A frame with a missing pitch, whose position is far off, also one on a node."""
    _, poses, commands = _flights(1, 13, 0.3)
    poses[0, 3] = [40.0, -9.0, NAN]
    poses[0, 8] = [NAN, 30.0, 0.1]
    return _nothing_smaller(f, poses, commands, 4, LINK)


def _tight_links(f: Function) -> bool:
    """By law: with links that hardly give it is one flight, wherever the nodes are."""
    _, poses, commands = _flights(1, 13, 0.3)
    (K, nodes), *found = (f(poses, commands, steps, 0.002 * LINK) for steps in (12, 3, 6))
    return all(
        is_close((each[0] - K) / PRIOR_SIGMA, np.zeros(8), 0.0, 0.002)
        and is_close(each[1][:, [0, -1]], nodes, 0.0, 0.001)
        for each in found
    )


def _unchanged(f: Function) -> bool:
    _, poses, commands = _flights(1, 9, 0.3)
    poses[0, 2] = NAN
    kept = poses.copy(), commands.copy(), LINK.copy()
    f(poses, commands, 4, LINK)
    return all(
        np.array_equal(a, b, equal_nan=True)
        for a, b in zip((poses, commands, LINK), kept, strict=True)
    )


SHOOTING = (
    Check(
        "a flight of GUESS without noise gives GUESS and the flown states",
        _flight_of_the_guess,
        "Return K and one state per node, that of the last row too. Command k acts from row k to "
        "row k + 1, each pass with its own.",
    ),
    Check(
        "two segments of four steps: no unknown can make the sum smaller",
        lambda f: _smallest_sum(f, 1, 9, 4),
        "Poses, links and prior, each over its own sigma. Every row counts once, and a link has "
        "five numbers. Go on until a round gains nothing.",
    ),
    Check(
        "steps of one row: each row is a node",
        lambda f: _smallest_sum(f, 1, 7, 1),
        "The flight from a node has one step and ends at the next one.",
    ),
    Check(
        "one segment from the first row to the last, with K far from the guess",
        lambda f: _smallest_sum(f, 1, 17, 16, off=0.8),
        "The last row has a node too, linked to the flight. Does S fall in every round? "
        "If not, shorten the step.",
    ),
    Check(
        "two passes share K, and nothing links one to the other",
        lambda f: _smallest_sum(f, 2, 9, 4, off=0.8),
        "One K for all; nodes and links of each pass for itself; the prior counts once.",
    ),
    Check(
        "a frame with one missing value does not count at all",
        _rows_that_do_not_count,
        "Replace it first: 0 times nan is nan. Also the first guess of the nodes meets it.",
    ),
    Check(
        "with tight links it does not matter where the nodes are",
        _tight_links,
        "A link compares all five numbers of a state, divided by sigma_link.",
    ),
    Check("what comes in is left as it was", _unchanged, "Work on copies of poses and commands."),
)

LAB = Lab(
    name="lab05",
    title="System identification",
    hours=4.5,
    notebook_since="0.2",  # the model's symbols are the textbook's since then
    exercises=(
        Exercise("local_slope", 8.0, LOCAL_SLOPE),
        Exercise("residuals", 10.0, RESIDUALS),
        Exercise("gauss_newton_step", 13.0, GAUSS_NEWTON),
        Exercise("intervals", 8.0, INTERVALS),
        Exercise("holdout_score", 8.0, HOLDOUT),
        Exercise("multiple_shooting", 18.0, SHOOTING, seconds=30.0, nearby=False, free=True),
        Exercise("forecast_turn", 10.0, TURN),
    ),
    rubric=(
        Criterion(
            "fit",
            7.0,
            "Histogram on the Gaussian; the cost has its bottom near 60 ms; "
            "the held-out track follows the points.",
        ),
        Criterion(
            "fit_reading",
            3.0,
            "A perfect model scores the marker's noise, 4.2 cm and 0.6 deg; "
            "explains what a wider histogram would mean, "
            "and why that window was not fitted.",
        ),
        Criterion(
            "real", 3.0, "Distances over time and their distribution; the model's are the smallest."
        ),
        Criterion(
            "real_reading",
            2.0,
            "Claims this flight's forecasts only; fitted initial states against measured ones; "
            "the verdict compares with the constant turn.",
        ),
        Criterion(
            "q1",
            5.0,
            "Noise in the variable flattens M_alpha (errors in variables); "
            "in cL_alpha the same noise is also the "
            "change to the next step; counts truths inside.",
        ),
        Criterion(
            "q2",
            5.0,
            "Neighbouring rows are not independent; initial states are no property of the "
            "aircraft.",
        ),
    ),
    constants={"far_sigmas": (2.0, 4.0, 1), "level_percent": (90.0, 98.0, 0)},
)
