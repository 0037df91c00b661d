"""Lab 13, public: the exercises, their public checks, and the rubric."""

import math

import numpy as np
from given import FLOOR_Z, IMAGE_EVERY, PAD, SOFT_SINK, WORTH_M

from falconwing_kit.tools.grading import Check, Criterion, Exercise, Function, Lab, is_close

CENTRE_Y = 0.5 * (PAD[2] + PAD[3])


def _one_each(merge: Function) -> bool:
    """A group of one is that Gaussian, whatever its weight; groups come in no order."""
    means, colours = np.arange(9.0).reshape(3, 3), np.eye(3)
    covs = np.array([np.diag([1.0, 2.0, 3.0]), np.eye(3), 4.0 * np.eye(3)])
    order = np.array([2, 0, 1])
    got = merge(means, covs, np.array([0.2, 3.0, 1.0]), colours, order)
    back = np.argsort(order)
    return all(is_close(a, b[back]) for a, b in zip(got, (means, covs, colours), strict=True))


def _two_points(merge: Function) -> bool:
    """By hand: points at -1 and 1 with equal weight have mean 0 and variance 1."""
    means = np.array([[-1.0, 0.0, 0.0], [1.0, 0.0, 0.0]])
    got = merge(means, np.zeros((2, 3, 3)), np.ones(2), np.eye(3)[:2], np.zeros(2, int))
    return is_close(got[0], np.zeros((1, 3))) and is_close(got[1], np.diag([1.0, 0.0, 0.0])[None])


def _weighted(merge: Function) -> bool:
    """By hand: 3 : 1 at 0 and 4 give mean 1, spread (3 * 1 + 9) / 4 = 3, plus 1 of their own."""
    means = np.array([[0.0, 0.0, 0.0], [0.0, 4.0, 0.0]])
    covs, colours = np.array([np.eye(3)] * 2), np.array([[1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])
    got = merge(means, covs, np.array([6.0, 2.0]), colours, np.zeros(2, int))
    return (
        is_close(got[0], [[0.0, 1.0, 0.0]])
        and is_close(got[1], np.diag([1.0, 4.0, 1.0])[None])
        and is_close(got[2], [[0.75, 0.25, 0.0]])
    )


def _middle_and_ends(sticks: Function) -> bool:
    """By hand: 1500 is the middle, half of the throttle; 2000 and 1000 are the ends."""
    got = sticks(np.array([1500.0, 2000.0, 1000.0, 1750.0]), "TAER", 1500.0, 500.0)
    return is_close(got, [0.5, 1.0, -1.0, 0.5])


def _other_order(sticks: Function) -> bool:
    """The answer's order stays: throttle first."""
    got = sticks(np.array([1520.0, 1720.0, 1120.0, 1420.0]), "AETR", 1520.0, 400.0)
    return is_close(got, [0.0, 0.0, 0.5, -0.25])


def _beyond(sticks: Function) -> bool:
    """Slots beyond the range are its ends, the throttle's too."""
    got = sticks(np.array([900.0, 2300.0, 600.0, 1500.0]), "TAER", 1500.0, 500.0)
    return is_close(got, [0.0, 1.0, -1.0, 0.0])


def _flown(fly: Function, lost: tuple[int, ...] = (), steps: int = 7, floor: float = -9.0) -> dict:
    """A flight in the small world of `given.run_fly`, through which `fly` is called."""
    gains = np.concatenate([np.full((4, 9), 0.3), np.full((4, 9), 0.2)], axis=1)
    return dict(fly(np.linspace(0.1, 0.9, 9), gains, np.array(lost, float), float(steps), floor))


def _counts(fly: Function) -> bool:
    """Seven steps: eight states, seven commands, and every second step's picture."""
    got = _flown(fly)
    return (
        np.shape(got["states"]) == (8, 9)
        and np.shape(got["commands"]) == (7, 4)
        and len(got["frames"]) == -(-7 // IMAGE_EVERY)
    )


def _pictures(fly: Function) -> bool:
    """The small world's picture is the state plus 0.5: pictures are of steps 0, 2, 4."""
    got = _flown(fly)
    return is_close(got["frames"], got["states"][:-1][::IMAGE_EVERY] + 0.5)


def _decides_with_the_newest_picture(fly: Function) -> bool:
    """0.5 (0.3 sum of the state + 0.2 sum of the newest picture) arrives at all four servos."""
    got = _flown(fly)
    states, frames = got["states"][:-1], np.repeat(got["frames"], IMAGE_EVERY, axis=0)[:7]
    expected = 0.5 * (0.3 * states.sum(axis=1) + 0.2 * frames.sum(axis=1))
    return is_close(got["commands"], np.tile(expected[:, None], 4))


def _holds(fly: Function) -> bool:
    """What does not arrive is what arrived last; zero at the very beginning."""
    commands = _flown(fly, lost=(0, 3, 4))["commands"]
    return (
        is_close(commands[0], np.zeros(4))
        and bool(np.all(commands[2] != 0.0))
        and is_close(commands[3], commands[2])
        and is_close(commands[4], commands[2])
        and not is_close(commands[5], commands[2])
    )


def _before_and_now(fly: Function) -> bool:
    """The small world's step, by hand from the servos before (zero at first) and now."""
    got = _flown(fly)
    before, now = np.zeros(4), got["commands"][0]
    for state, after, now in zip(got["states"], got["states"][1:], got["commands"], strict=False):
        push = np.concatenate([[0.0, 0.0, -0.1], 0.3 * before[:3], 0.2 * now[:3]])
        if not is_close(after, 0.97 * state + 0.1 * push):
            return False
        before = now
    return True


def _ends(fly: Function) -> bool:
    """pz starts at 0.3 and falls slowly; the first state at or below 0.25 is the last one."""
    height = _flown(fly, steps=40, floor=0.25)["states"][:, 2]
    return 2 < len(height) < 40 and bool(height[-1] <= 0.25 < height[-2])


def _two_rows(x: float, y: float, sink: float, share: float) -> np.ndarray:
    """A flight of three rows that touches at (x, y), `share` of the way between the last two."""
    states = np.zeros((3, 9))
    states[:, 0] = x + 0.35 * np.array([-1.0 - share, -share, 1.0 - share])
    states[:, 1] = y + 0.05 * np.array([-1.0 - share, -share, 1.0 - share])
    states[:, 2] = FLOOR_Z + 0.02 * np.array([1.0 + share, share, share - 1.0])
    states[:, 8] = -sink + 0.1 * np.array([-1.0 - share, -share, 1.0 - share])
    return states


def _on_the_line(score: Function) -> bool:
    """On the line and soft: 100 points, touched down between the rows."""
    got = score(_two_rows(6.0, CENTRE_Y, 0.5 * SOFT_SINK, 0.25))
    return is_close(got, (6.0, 0.0, 0.5 * SOFT_SINK, 100.0))


def _off_the_line(score: Function) -> bool:
    """By hand: half of WORTH_M off the line, to either side, leaves exp(-1/4) of the points."""
    off, expected = 0.5 * WORTH_M, 100.0 * math.exp(-0.25)
    rows = [_two_rows(3.0, CENTRE_Y + side * off, 0.1, 0.5) for side in (-1.0, 1.0)]
    return all(is_close(score(row), (3.0, off, 0.1, expected)) for row in rows)


def _hard(score: Function) -> bool:
    """Twice the soft sink rate is worth half."""
    return is_close(score(_two_rows(9.0, CENTRE_Y, 2.0 * SOFT_SINK, 0.6))[3], 50.0)


def _beside(score: Function) -> bool:
    """Too short, too long, to either side: 0 points, but the place is given."""
    places = ((PAD[0] - 0.5, CENTRE_Y), (PAD[1] + 0.5, CENTRE_Y), (5.0, -3.2), (5.0, -0.8))
    return all(
        is_close(score(_two_rows(x, y, 0.4, 0.5)), (x, abs(y - CENTRE_Y), 0.4, 0.0))
        for x, y in places
    )


def _in_the_air(score: Function) -> bool:
    """A flight that never comes down: four zeros."""
    states = np.ones((5, 9))
    return is_close(score(states), (0.0, 0.0, 0.0, 0.0))


LAB = Lab(
    name="lab13",
    title="Fly your own",
    hours=4.0,
    exercises=(
        Exercise(
            "merge_gaussians",
            25.0,
            (
                Check(
                    "a group of one Gaussian is that Gaussian",
                    _one_each,
                    "the answer is sorted by group number, and weights cancel in a group of one",
                ),
                Check(
                    "two points one metre off the middle make a variance of 1 m^2",
                    _two_points,
                    "the means' own spread about the new mean belongs to the covariance",
                ),
                Check(
                    "a heavier Gaussian draws mean, covariance and colour towards itself",
                    _weighted,
                    "every sum has the weights, and is divided by the sum of the weights",
                ),
            ),
        ),
        Exercise(
            "sticks_from_slots",
            10.0,
            (
                Check(
                    "the middle slot is half of the throttle and 0 of a stick",
                    _middle_and_ends,
                    "the throttle's -1..1 becomes 0..1",
                ),
                Check(
                    "the answer's order is the same for every order of the channels",
                    _other_order,
                    "find each channel by its letter",
                ),
                Check(
                    "a slot beyond the range is its end",
                    _beyond,
                    "limit the position to -1..1 before it becomes a throttle",
                ),
            ),
        ),
        Exercise(
            "fly",
            25.0,
            (
                Check(
                    "seven steps have eight states, seven commands and four pictures",
                    _counts,
                    "the start is a state too; the first step takes a picture",
                ),
                Check(
                    "pictures show the state in which they are taken",
                    _pictures,
                    "look before the aircraft moves on",
                ),
                Check(
                    "a decision has the state and the newest picture",
                    _decides_with_the_newest_picture,
                    "without a new picture the last one is used, not None",
                ),
                Check(
                    "servos hold what arrived last, zero at the beginning",
                    _holds,
                    "carry returns None where nothing arrives; the new command is lost then",
                ),
                Check(
                    "the aircraft moves by the servos before and now",
                    _before_and_now,
                    "before is the last step's `now`, also after a lost command",
                ),
                Check(
                    "the flight ends with the first state at or below the floor",
                    _ends,
                    "look at pz of the new state, and keep it",
                ),
            ),
            through="run_fly",
        ),
        Exercise(
            "landing_score",
            15.0,
            (
                Check(
                    "a soft touchdown on the line has 100 points, between the last two rows",
                    _on_the_line,
                    "all of the state is interpolated with the same share, the sink rate too",
                ),
                Check(
                    "half of WORTH_M off the line is worth exp(-1/4), left as right",
                    _off_the_line,
                    "the centre line is half way between PAD's two y",
                ),
                Check(
                    "twice the soft sink rate is worth half",
                    _hard,
                    "SOFT_SINK over the sink rate, at most 1",
                ),
                Check(
                    "beside the pad there are no points",
                    _beside,
                    "x from, to, y from, to; the other three numbers stay as they are",
                ),
                Check(
                    "a flight that stays in the air has four zeros",
                    _in_the_air,
                    "compare the last row's height with FLOOR_Z first",
                ),
            ),
        ),
    ),
    rubric=(
        Criterion("film", 5.0, "the film shows the flight to the pad; pictures, track and banks"),
        Criterion("film_reading", 7.0, "the policy leaves in the turn; 3 % lost, without effect"),
        Criterion("gap", 3.0, "one bar far above the threshold"),
        Criterion(
            "q1", 5.0, "names what is hidden, with its size; the others only have their price"
        ),
        Criterion("q2", 5.0, "open loop drifts off; close it by picture and pose"),
    ),
    constants={
        "worth_m": (0.5, 1.1, 2),
        "soft_sink": (0.6, 1.2, 2),
        "trust_deg": (3.0, 5.0, 1),
        "hidden_number": (0.0, 3.0, 0),
    },
)
