"""Lab 7, public: the exercises, what a right function does, and what a person looks for."""

import math

import numpy as np
from given import (
    APPROACH,
    ASIDE,
    COHORT,
    FLARE_TIME,
    GLIDE,
    GRAVITY,
    KI,
    KINDS,
    KP,
    LIFT_0,
    LIFT_SLOPE,
    PULL,
    SLOPE_GAIN,
    STALL_ALPHA,
    STEEPEST,
    STEP,
    TURN_GAIN,
)

from falconwing_kit.tools.grading import Check, Criterion, Exercise, Function, Lab, is_same_answer

MOST_LIFT = (
    LIFT_0 + LIFT_SLOPE * STALL_ALPHA
)  # of the course's wing, over mass and speed squared [1/m]
SOFT = COHORT["touch_sink"]
ORIGIN, EAST, NORTH = np.zeros(2), np.array([10.0, 0.0]), np.array([0.0, 10.0])


def _bank_45(turn: Function) -> bool:
    """By hand: V^2 = g R makes tan(bank) = 1, n = sqrt 2, V_stall^2 = sqrt 2 g / most."""
    margin = 6.0 / math.sqrt(math.sqrt(2.0) * GRAVITY / MOST_LIFT)
    return is_same_answer(turn(6.0, 0.0, 36.0 / GRAVITY), (math.pi / 4.0, margin))


def _left_turn(turn: Function) -> bool:
    """By hand: to the left the bank is -45 deg, and the wing works as hard as to the right."""
    right, left = turn(6.0, 0.0, 36.0 / GRAVITY), turn(6.0, 0.0, -36.0 / GRAVITY)
    return is_same_answer(left, (-math.pi / 4.0, right[1]))


def _climbing_turn(turn: Function) -> bool:
    """By hand: climbing by 60 deg, cos = 1/2, R = V^2 / (2 g): 45 deg again, n = (1/2) sqrt 2."""
    margin = 6.0 / math.sqrt(0.5 * math.sqrt(2.0) * GRAVITY / MOST_LIFT)
    return is_same_answer(turn(6.0, math.pi / 3.0, 18.0 / GRAVITY), (math.pi / 4.0, margin))


def _almost_straight(turn: Function) -> bool:
    """Limit: an endless radius needs no bank, and the margin grows in proportion to the speed."""
    slow, fast = turn(5.0, 0.0, 1e12), turn(10.0, 0.0, 1e12)
    margin = 5.0 / math.sqrt(GRAVITY / MOST_LIFT)
    return is_same_answer((*slow, fast[1] / slow[1]), (0.0, margin, 2.0))


def _level_nose(turn_rates: Function) -> bool:
    """By hand: at 45 deg and V = g the turn rate is 1 rad/s, shared by q and r.

    To the left only r turns round.
    """
    half = math.sqrt(0.5)
    right, left = turn_rates(math.pi / 4.0, 0.0, GRAVITY), turn_rates(-math.pi / 4.0, 0.0, GRAVITY)
    return is_same_answer((right, left), ((0.0, half, half), (0.0, half, -half)))


def _one_turn(turn_rates: Function) -> bool:
    """A law: p, q, r are one vector of length g tan(bank) / V, whatever the pitch."""
    rates = [turn_rates(0.6, pitch, 6.5) for pitch in (-0.4, 0.0, 0.7)]
    lengths = [math.sqrt(sum(float(rate) ** 2 for rate in each)) for each in rates]
    return is_same_answer(lengths, [GRAVITY * math.tan(0.6) / 6.5] * 3)


def _nose_up(turn_rates: Function) -> bool:
    """By hand: nose up by 30 deg in a right turn: p = -1/2 of the turn rate."""
    p, q, r = turn_rates(math.pi / 4.0, math.pi / 6.0, GRAVITY)
    return is_same_answer((p, q, r), (-0.5, math.sqrt(0.375), math.sqrt(0.375)))


def _on_the_line(guidance: Function) -> bool:
    """By hand: on the line and along it there is nothing to do, whatever its direction."""
    on = [
        guidance(0.3 * end, 0.7 * end, ORIGIN, end, 0.7)
        for end in (EAST, NORTH, -EAST, -NORTH, EAST + NORTH)
    ]
    return is_same_answer([float(bank) for bank in on], [0.0] * 5, atol=1e-9)


def _right_of_it(guidance: Function) -> bool:
    """By hand: 1 / k right of the line the arc tangent is 45 deg: course -APPROACH / 2."""
    p, v = np.array([3.0, -1.0 / PULL]), np.array([2.0, 0.0])
    expected = math.atan(2.0 * TURN_GAIN * -0.5 * APPROACH / GRAVITY)
    mirrored = guidance(p * (1.0, -1.0), v, ORIGIN, EAST, 1.0)
    return is_same_answer((guidance(p, v, ORIGIN, EAST, 1.0), mirrored), (expected, -expected))


def _line_that_begins_elsewhere(guidance: Function) -> bool:
    """By hand: the line runs along +y through x = 5.

    An aircraft at x = 5 + 1 / k is to its right.
    """
    start, end, p = np.array([5.0, 2.0]), np.array([5.0, 4.0]), np.array([5.0 + 1.0 / PULL, -7.0])
    expected = math.atan(3.0 * TURN_GAIN * -0.5 * APPROACH / GRAVITY)
    return is_same_answer(guidance(p, np.array([0.0, 3.0]), start, end, 1.4), expected)


def _short_way_round(guidance: Function) -> bool:
    """By hand: the line leads to -x.

    From 10 deg left of it, that is the course 170 deg, turn 10 deg to the right.
    """
    c, s = math.cos(math.radians(170.0)), math.sin(math.radians(170.0))
    expected = math.atan(3.0 * TURN_GAIN * math.radians(10.0) / GRAVITY)
    towards, back = (guidance(ORIGIN, 3.0 * np.array([c, y]), ORIGIN, -EAST, 1.4) for y in (-s, s))
    return is_same_answer((towards, back), (expected, -expected))


def _stays_within(guidance: Function) -> bool:
    """By hand: across the line at 9 m/s the bank would exceed the limit, on both sides."""
    both = [guidance(ORIGIN, np.array([0.0, v]), ORIGIN, EAST, 0.3) for v in (9.0, -9.0)]
    return is_same_answer([float(bank) for bank in both], [0.3, -0.3])


def _one_step(hold_speed: Function) -> bool:
    """By hand: one step adds error * STEP to the sum before it is used."""
    new = 0.4 - 0.5 * STEP
    return is_same_answer(hold_speed(-0.5, 0.4, 0.5), (0.5 - 0.5 * KP + KI * new, new))


def _does_not_wind_up(hold_speed: Function) -> bool:
    """By hand: far too slow, full throttle and the sum stays.

    Far too fast, idle and the sum stays.
    """
    return is_same_answer(
        (hold_speed(9.0, 0.2, 0.3), hold_speed(-9.0, -0.2, 0.3)), ((1.0, 0.2), (0.0, -0.2))
    )


def _winds_down(hold_speed: Function) -> bool:
    """By hand: at full throttle by an old sum, but too fast already: the sum must shrink.

    And the mirror image.
    """
    large = 5.0 / KI
    high, low = hold_speed(-0.4, large, 0.2), hold_speed(0.4, -large, 0.8)
    return is_same_answer((high, low), ((1.0, large - 0.4 * STEP), (0.0, -large + 0.4 * STEP)))


def _throttle_with_the_old_sum(hold_speed: Function) -> bool:
    """By hand: just below full throttle with the old sum, just above with the new one."""
    error = 1.0
    base = 1.0 - KP * error - 0.5 * KI * error * STEP
    return is_same_answer(hold_speed(error, 0.0, base), (base + KP * error, 0.0))


def _on_the_slope(flare: Function) -> bool:
    """By hand: high above the flare and on the slope: V sin(glide) down, motor running."""
    return is_same_answer(flare(20.0 * math.tan(GLIDE), 20.0, 7.0), (-7.0 * math.sin(GLIDE), False))


def _below_and_above_the_slope(flare: Function) -> bool:
    """By hand: 0.3 m below the slope it sinks 0.3 * gain less, 5 m below not at all.

    5 m above as steep as allowed.
    """
    slope = 60.0 * math.tan(GLIDE)
    expected = -(7.0 * math.sin(GLIDE) - 0.3 * SLOPE_GAIN)
    got = [flare(slope + off, 60.0, 7.0)[0] for off in (-0.3, -5.0, 5.0)]
    return is_same_answer([float(rate) for rate in got], [expected, 0.0, -7.0 * math.sin(STEEPEST)])


def _soft_at_the_end(flare: Function) -> bool:
    """By hand: at the pad the touchdown sink rate, above it plus h / tau, below it as at it."""
    height = 0.1 * FLARE_TIME
    got = [flare(h, height / math.tan(GLIDE), 7.0) for h in (0.0, height, -0.2)]
    return is_same_answer(got, [(-SOFT, True), (-SOFT - 0.1, True), (-SOFT, True)])


def _less_of_both(flare: Function) -> bool:
    """By hand: near the pad, so far below the slope that the approach sinks less than the flare."""
    rate, idle = flare(0.3, 0.3 / math.tan(GLIDE) + 10.0, 7.0)
    expected = -max(7.0 * math.sin(GLIDE) - 10.0 * math.tan(GLIDE) * SLOPE_GAIN, 0.0)
    return is_same_answer((rate, idle), (expected, False), atol=1e-9)


SEEDS = (3, 5, 14)  # of starts on both ends of what is drawn
SOFTLY = 0.2  # more than touch_sink in the small world, which has no lag below these loops [m/s]


def _landings(expert: Function, *kinds: str) -> list[dict]:
    """Landings in the small world of given.py: two of each kind."""
    return list(expert("land", *[(kind, seed) for kind in kinds for seed in SEEDS]))


def _all_land(expert: Function, *kinds: str) -> bool:
    return all(
        each["touched"] == "pad" and each["aside"] <= ASIDE and each["sink"] <= SOFT + SOFTLY
        for each in _landings(expert, *kinds)
    )


def _forgets(expert: Function) -> bool:
    """One object lands in each way, after another one: each is what it is at first."""
    kinds = [(kind, 14) for kind in KINDS]
    first = [expert("land", (KINDS[0], 14), each)[1] for each in kinds]
    again = expert("land", *reversed(kinds))[::-1]
    return all(each["touched"] == "pad" for each in first) and is_same_answer(again, first)


def _idle_at_the_end(expert: Function) -> bool:
    """No motor in the last step, and one on the way: a throttle of 0 all the time would be slow."""
    ends = [each["throttle"] for each in _landings(expert, *KINDS)]
    expert("reset")
    level = np.array([7.0, 0.0, 0.0])
    slow = expert("act", np.array([-18.0, -2.0, 2.0]), 0.8 * level, 0.0, 0.1)
    return max(ends) == 0.0 and slow[2] > 0.3


def _flies_towards(expert: Function) -> bool:
    """Beside the line, on a straight approach: towards it from both sides, and level on it."""
    banks = []
    for y in (-4.0, -2.0, 0.0):
        expert("reset")
        level = np.array([7.0, 0.0, 0.0])
        banks.append(expert("act", np.array([-18.0, y, 1.8]), level, 0.0, 0.08)[0])
    return banks[0] < -0.1 and abs(banks[1]) < 1e-6 and banks[2] > 0.1


LANDING = (
    Check(
        "`act` gives a bank, a vertical speed and a throttle: finite, and within their limits",
        lambda f: all(0 < each["answers"] == each["steps"] for each in _landings(f, *KINDS)),
        "return a tuple of three numbers in every mode: at most 60 degrees, 3 m/s, and 0..1",
    ),
    Check(
        "straight in, it flies towards the centre line from both sides",
        _flies_towards,
        "`guidance` with a line that ends at AIM; y is to the left",
    ),
    Check(
        "straight in, it lands: on the pad, near the line, softly (0.2 m/s in a small world)",
        lambda f: _all_land(f, "straight in"),
        "`flare` with the height of the wheels above the pad, and the way to AIM",
    ),
    Check(
        "from downwind on the left it turns round and lands",
        lambda f: _all_land(f, "downwind left"),
        "turn towards the centre line, before the wall at x = -22.5 m; a half circle at 45 degrees "
        "is 10 m wide",
    ),
    Check(
        "from downwind on the right it turns round the other way and lands",
        lambda f: _all_land(f, "downwind right"),
        "the side that it begins on decides the sign of the turn",
    ),
    Check(
        "the motor is idle when the wheels touch, and works where it is too slow",
        _idle_at_the_end,
        "remember that the flare has begun; `hold_speed` before that",
    ),
    Check(
        "a landing after `reset` is like the first of a new object",
        _forgets,
        "`reset` sets back everything that `act` remembers: mode, integral, idle motor",
    ),
)


LAB = Lab(
    name="lab07",
    title="The expert",
    hours=4.0,
    exercises=(
        Exercise(
            "turn",
            11.0,
            (
                Check(
                    "V^2 = g R makes a bank of 45 deg and n = sqrt 2",
                    _bank_45,
                    "divide the two equations of the lift; V_stall^2 (c_0 + c_alpha alpha_stall) = "
                    "n g",
                ),
                Check(
                    "to the left the bank is negative and the margin the same",
                    _left_turn,
                    "keep the radius's sign",
                ),
                Check(
                    "a climbing turn: cos(climb) once in the bank, once in n",
                    _climbing_turn,
                    "the level speed is V cos(climb), squared; one cos cancels when you divide. "
                    "Without any cos(climb) neither bank nor n would depend on the climb",
                ),
                Check(
                    "straight on there is no bank, and the margin goes with the speed",
                    _almost_straight,
                    "margin = V / V_stall, with a root in V_stall",
                ),
            ),
        ),
        Exercise(
            "turn_rates",
            8.0,
            (
                Check(
                    "a level nose at 45 deg: q and r share the turn; q is positive on both sides",
                    _level_nose,
                    "the turn rate is g tan(bank) / V and has the bank's sign",
                ),
                Check(
                    "the three are one vector, whatever the pitch",
                    _one_turn,
                    "cos(pitch) belongs to q and to r",
                ),
                Check(
                    "nose up in a right turn, p is negative",
                    _nose_up,
                    "look at the sign and the angle in p",
                ),
            ),
        ),
        Exercise(
            "guidance",
            15.0,
            (
                Check(
                    "on the line and along it, no bank",
                    _on_the_line,
                    "course = atan2(-y, x) for the line and for the velocity",
                ),
                Check(
                    "1 / PULL to the right of it, it turns left by half of APPROACH",
                    _right_of_it,
                    "with y to the left, right of the direction (x, y) is (y, -x); "
                    "divide it by its length. V is the "
                    "length of v",
                ),
                Check(
                    "the line need not pass through the origin",
                    _line_that_begins_elsewhere,
                    "e is measured from `start`, across the line's unit direction",
                ),
                Check(
                    "it turns the short way round",
                    _short_way_round,
                    "bring the error between -pi and pi before use",
                ),
                Check(
                    "the bank stays within its limit on both sides",
                    _stays_within,
                    "limit the bank, not the course",
                ),
            ),
        ),
        Exercise(
            "hold_speed",
            10.0,
            (
                Check(
                    "one step, by hand",
                    _one_step,
                    "add error * STEP to the sum first, then use the new sum",
                ),
                Check(
                    "at a limit that the error pushes into, the sum stands still",
                    _does_not_wind_up,
                    "return the old integral there, and the limited throttle",
                ),
                Check(
                    "at a limit that the error leads away from, the sum goes on",
                    _winds_down,
                    "both conditions are needed: beyond the limit, and the error's sign",
                ),
                Check(
                    "where the sum stands still, the throttle uses the old one",
                    _throttle_with_the_old_sum,
                    "compute the throttle again before limiting it",
                ),
            ),
        ),
        Exercise(
            "flare",
            11.0,
            (
                Check(
                    "on the slope, V sin(GLIDE) down, motor running",
                    _on_the_slope,
                    "check the sign: climb rate",
                ),
                Check(
                    "below the slope it sinks less, above it more, within limits",
                    _below_and_above_the_slope,
                    "d tan(GLIDE) - h is how much too low it is; limit its sink rate to 0 .. "
                    "V sin(STEEPEST)",
                ),
                Check(
                    "the sink rate falls with the height to that of the touchdown",
                    _soft_at_the_end,
                    "touch_sink + h / FLARE_TIME, h not below 0; idle is True here",
                ),
                Check(
                    "whichever sinks less",
                    _less_of_both,
                    "compare both sink rates; only where the flare is smaller is the motor idle",
                ),
            ),
        ),
        Exercise(
            "LandingExpert",
            20.0,
            LANDING,
            through="ask_expert",
            seconds=30.0,
            nearby=False,
            free=True,
        ),
    ),
    rubric=(
        Criterion(
            "circuit",
            5.0,
            "a track round the legs clear of the walls; bank, margin and commands",
        ),
        Criterion(
            "circuit_reading",
            3.0,
            "the margin is smallest where turns begin (n), ripples by noise; "
            "right banks end an overshoot",
        ),
        Criterion("landing", 4.0, "both landings, the flare's bend, both sink rates at the pad"),
        Criterion(
            "landing_reading",
            3.0,
            "a flare costs about two metres of pad; the aircraft answers late; "
            "a height measured 10 cm too high lets "
            "it flare late: two metres earlier on the pad and harder",
        ),
        Criterion(
            "q1",
            5.0,
            "q is a product of two factors that both change sign; r and p are not; "
            "n > 1 adds to it",
        ),
        Criterion(
            "q2",
            5.0,
            "the course loop must be slower than bank and delay, else it weaves; gain times delay; "
            "more delay shows in "
            "the innermost loops and the flare",
        ),
    ),
    constants={
        "approach_deg": (50.0, 70.0, 0),
        "stall_alpha_deg": (10.0, 14.0, 1),
        "touch_sink": (0.15, 0.25, 2),
    },
)
