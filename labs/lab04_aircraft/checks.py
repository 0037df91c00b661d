"""Lab 4, public: claims about an aircraft model that a student can read and run."""

import math
from collections.abc import Sequence

import numpy as np
from given import DOWN_THRUST, GRAVITY, K

from falconwing_kit.tools.grading import Check, Criterion, Exercise, Function, Lab, is_close

Array = np.ndarray
CALM = np.zeros(3)


def _state(
    attitude: Sequence[float] = (0.0, 0.0, 0.0), velocity: Sequence[float] = (7.0, 0.0, 0.0)
) -> Array:
    """A state at 2 m height; attitude is pitch, yaw, roll."""
    return np.array([0.0, 0.0, 2.0, *attitude, *velocity])


def _unturned(f: Function) -> bool:
    """The same flow when heading, velocity and wind are turned together about the vertical."""
    velocity, wind, c, s = (
        np.array([6.0, 1.0, -0.5]),
        np.array([0.5, -0.7, 0.2]),
        math.cos(0.8),
        math.sin(0.8),
    )
    R = np.array([[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]])  # nose right is clockwise from above
    here = f(_state((0.2, 0.3, 0.4), velocity.tolist()), wind)
    return is_close(f(_state((0.2, 1.1, 0.4), (R @ velocity).tolist()), R @ wind), here)


AIR_DATA = (
    Check(
        "straight ahead at 7 m/s in still air: V = 7, both angles zero",
        lambda f: is_close(f(_state(), CALM), [7.0, 0.0, 0.0]),
        "Return an array of three numbers; the body's x axis is the nose.",
    ),
    Check(
        "level path, nose 0.1 rad up: the angle of attack is +0.1",
        lambda f: is_close(f(_state((0.1, 0.0, 0.0)), CALM), [7.0, 0.1, 0.0]),
        "R_world_body turns body vectors into the world; you need the other way. "
        "Body z points to the belly.",
    ),
    Check(
        "nose 0.1 rad to the right of the path: the sideslip is -0.1, the air comes from the left",
        lambda f: is_close(f(_state((0.0, 0.1, 0.0)), CALM), [7.0, 0.0, -0.1]),
        "Which of the state's three angles is the yaw?",
    ),
    Check(
        "6 m/s ahead, 2 to the right and 3 down: V = 7, tan(alpha) = 3/6, sin(beta) = 2/7",
        lambda f: is_close(
            f(_state(velocity=(6.0, -2.0, -3.0)), CALM), [7.0, math.atan(0.5), math.asin(2 / 7)]
        ),
        "World y is left and z up, body y is right and z down. Sideslip is the arcsine of v / V.",
    ),
    Check(
        "banked 90 degrees to the right, a sideways path is an angle of attack",
        lambda f: is_close(
            f(_state((0.0, 0.0, math.pi / 2), (7.0, 1.0, 0.0)), CALM),
            [math.sqrt(50), math.atan(1 / 7), 0],
        ),
        "The belly then points to the left. Check the order of the angles in the state.",
    ),
    Check(
        "a tail wind of 2 m/s leaves 5 m/s of airspeed, and rising air raises the angle of attack",
        lambda f: (
            is_close(f(_state(), np.array([2.0, 0.0, 0.0])), [5.0, 0.0, 0.0])
            and f(_state(), np.array([0.0, 0.0, 1.0]))[1] > 0.1
        ),
        "Velocity through the air is velocity over the ground less that of the air.",
    ),
    Check(
        "turning flight and wind together about the vertical changes nothing",
        _unturned,
        "Is the wind turned too?",
    ),
)

FORCE_AIR = np.array([7.0, 0.08, 0.1])
IDLE, FULL = np.zeros(4), np.array([1.0, 0.0, 0.0, 0.0])


def _lift_and_drag(f: Function) -> bool:
    """Two degrees and a half by hand: force across and along the path without sideslip."""
    alpha, V = 0.05, 8.0
    x, y, z = f(np.array([V, alpha, 0.0]), IDLE, K)
    across, along = (
        x * math.sin(alpha) - z * math.cos(alpha),
        x * math.cos(alpha) + z * math.sin(alpha),
    )
    c = 0.078 + 1.40 * 0.05
    return is_close([across, along, y], [64.0 * c, -64.0 * (0.0155 + 0.2 * c**2), 0.0])


def _drag_opposes(f: Function) -> bool:
    """In a slip without lift and side force what remains lies against the path."""
    K0 = {**K, "cL_0": -K["cL_alpha"] * 0.08, "cY_beta": 0.0}
    path = np.array([math.cos(0.08) * math.cos(0.3), math.sin(0.3), math.sin(0.08) * math.cos(0.3)])
    return is_close(f(np.array([7.0, 0.08, 0.3]), IDLE, K0), -49.0 * 0.0155 * path)


BODY_FORCE = (
    Check(
        "at 8 m/s and alpha 0.05: lift 9.47 m/s^2 across the path, drag 1.27 m/s^2 against it",
        _lift_and_drag,
        "c = cL_0 + cL_alpha alpha; V counts squared; c counts squared in the drag.",
    ),
    Check(
        "twice the speed, four times the force without thrust",
        lambda f: is_close(
            f(np.array([14.0, 0.08, 0.1]), IDLE, K), 4.0 * np.asarray(f(FORCE_AIR, IDLE, K))
        ),
        "Every aerodynamic force goes with the square of the speed.",
    ),
    Check(
        "in a slip drag lies against the path",
        _drag_opposes,
        "The path has a part along y, sin(beta).",
    ),
    Check(
        "wind on the right cheek pushes the aircraft to the left",
        lambda f: is_close(
            (np.asarray(f(FORCE_AIR, IDLE, K)) - f(FORCE_AIR, IDLE, {**K, "cY_beta": 0.0})),
            [0.0, -49.0 * 0.25 * 0.1, 0.0],
        ),
        "The side force is V^2 cY_beta beta along y, and cY_beta is negative.",
    ),
    Check(
        "full throttle at 7 m/s adds 5.5 m/s^2 along the propeller's axis, "
        "which points down in front",
        lambda f: is_close(
            np.asarray(f(FORCE_AIR, FULL, K)) - f(FORCE_AIR, IDLE, K),
            [5.5 * math.cos(DOWN_THRUST), 0.0, 5.5 * math.sin(DOWN_THRUST)],
        ),
        "Thrust falls with speed: kT - kTV V. Body z points down, so down-thrust is a positive z; "
        "its angle is in rad.",
    ),
)

LEVEL_FORCE = np.array([0.0, 0.0, -GRAVITY])
MOVING = _state((0.3, -0.4, 0.5), (6.0, 1.0, -0.5))
NO_RATES = np.zeros(3)


def _turns_level(f: Function) -> bool:
    """A level coordinated turn: a rotation about the vertical changes only the yaw."""
    pitch, roll, turn = 0.1, 0.6, 0.8
    about_down = [
        -math.sin(pitch),
        math.cos(pitch) * math.sin(roll),
        math.cos(pitch) * math.cos(roll),
    ]
    got = f(_state((pitch, 1.0, roll)), LEVEL_FORCE, turn * np.array(about_down))
    return is_close(got[3:6], [0.0, turn, 0.0])


STATE_RATE = (
    Check(
        "wings level, lift as large as the weight: the velocity stays, the position moves with it",
        lambda f: is_close(f(_state(), LEVEL_FORCE, NO_RATES), [7.0, 0, 0, 0, 0, 0, 0, 0, 0]),
        "World z is up: gravity is -9.8 in the last entry.",
    ),
    Check(
        "force free it falls, whatever its attitude",
        lambda f: is_close(f(MOVING, np.zeros(3), NO_RATES)[6:], [0.0, 0.0, -GRAVITY]),
        "Gravity is already in the world: do not turn it.",
    ),
    Check(
        "banked 90 degrees to the right, lift pulls to the right: along -y",
        lambda f: is_close(
            f(_state((0.0, 0.0, math.pi / 2)), LEVEL_FORCE, NO_RATES)[6:], [0.0, -GRAVITY, -GRAVITY]
        ),
        "Body vectors are turned into the world by R_world_body itself; "
        "the order in the state is pitch, yaw, roll.",
    ),
    Check(
        "nose up 30 degrees, a push along the nose lifts by half",
        lambda f: is_close(
            f(_state((math.pi / 6, 0.0, 0.0)), np.array([2.0, 0.0, 0.0]), NO_RATES)[6:],
            [math.sqrt(3.0), 0.0, 1.0 - GRAVITY],
        ),
        "Is it R or its transpose?",
    ),
    Check(
        "level attitude: p, q, r are the rates of roll, pitch, yaw",
        lambda f: is_close(
            f(_state(), LEVEL_FORCE, np.array([0.1, 0.2, 0.3]))[3:6], [0.2, 0.3, 0.1]
        ),
        "The state's order is pitch, yaw, roll; the rates' is p (roll), q (pitch), r (yaw).",
    ),
    Check(
        "body rates that are a turn about the vertical change only the yaw",
        _turns_level,
        "Look at the signs, and at tan and cos of the pitch.",
    ),
)

NOTHING, ONE = np.zeros((1, 1)), np.ones((1, 1))
CHAIN = np.array(
    [[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]]
)  # each the integral of the one before
INTO_FIRST, X0 = np.array([[1.0], [0.0], [0.0]]), np.array([1.0, 2.0, 3.0])


def _end(f: Function, *arguments: object) -> Array:
    """The state after the step; `given.step_linear` also returns what became of the one before."""
    return np.asarray(f(*arguments)[0])


def _integrates(f: Function) -> bool:
    """Three integrals of an input that rises from 1 to 3 within 2 s, u = 1 + t: exact, by hand."""
    # t + t^2/2 = 4, t^2/2 + t^3/6 = 10/3, t^3/6 + t^4/24 = 2 at t = 2.
    end = _end(f, CHAIN, INTO_FIRST, np.zeros(3), np.array([1.0]), np.array([3.0]), 2.0)
    return is_close(end, [4.0, 10.0 / 3.0, 2.0])


def _leaves_alone(f: Function) -> bool:
    return bool(np.array_equal(f(CHAIN, INTO_FIRST, X0.copy(), np.ones(1), np.ones(1), 0.5)[1], X0))


RK4 = (
    Check(
        "one step of dx/dt = x gives 65/24, the first five terms of e",
        lambda f: is_close(
            _end(f, ONE, NOTHING, np.ones(1), np.zeros(1), np.zeros(1), 1.0), [65.0 / 24.0]
        ),
        "The weights are 1, 2, 2, 1 over 6; k2 and k3 look half a step ahead, "
        "each with the slope before it.",
    ),
    Check(
        "an input that rises linearly is followed exactly",
        _integrates,
        "k1 sees u_now, k2 and k3 the mean, k4 u_next.",
    ),
    Check(
        "a step of no length changes nothing",
        lambda f: is_close(_end(f, CHAIN, INTO_FIRST, X0.copy(), np.ones(1), np.ones(1), 0.0), X0),
        "Every slope is multiplied by the step.",
    ),
    Check(
        "the state that comes in is left as it was",
        _leaves_alone,
        "x += ... changes the caller's array: write x = x + ...",
    ),
)


def _balanced(f: Function, V: float, climb: float) -> bool:
    """The answer put back into the two force balances and the pitch rate."""
    alpha, throttle, elevator = f(V, climb, K)
    c, T = K["cL_0"] + K["cL_alpha"] * alpha, (K["kT"] - K["kTV"] * V) * throttle
    drag, tilt = V**2 * (K["cD_0"] + K["cD_induced"] * c**2), alpha - DOWN_THRUST
    along = T * math.cos(tilt) - drag - GRAVITY * math.sin(climb)
    across = V**2 * c + T * math.sin(tilt) - GRAVITY * math.cos(climb)
    return is_close(
        [along, across, K["M_0"] + K["M_de"] * elevator + K["M_alpha"] * alpha],
        [0.0, 0.0, 0.0],
        atol=1e-7,
    )


TRIM = (
    Check(
        "level flight at 7 m/s: the forces balance and the nose does not turn",
        lambda f: np.shape(f(7.0, 0.0, K)) == (3,) and _balanced(f, 7.0, 0.0),
        "Return angle of attack, throttle, elevator. Put your answer into the three equations: "
        "which one is open?",
    ),
    Check(
        "a climb of 15 degrees at 8 m/s balances too",
        lambda f: _balanced(f, 8.0, math.radians(15.0)),
        "Weight has a part along the path, g sin(gamma), and one across, g cos(gamma). "
        "climb_angle is in rad.",
    ),
    Check(
        "so does a slow descent, to seven digits",
        lambda f: _balanced(f, 5.5, math.radians(-12.0)),
        "Are there enough rounds? Are V, thrust and angle of attack those of the last one?",
    ),
    Check(
        "slower flight takes more elevator, a steeper climb more throttle",
        lambda f: f(6.0, 0.0, K)[2] > f(8.0, 0.0, K)[2] and f(7.0, 0.2, K)[1] > f(7.0, 0.0, K)[1],
        "Check the signs of M_alpha and of g sin(gamma).",
    ),
)

LAB = Lab(
    name="lab04",
    title="The aircraft model",
    hours=3.0,
    notebook_since="0.2",  # the model's symbols are the textbook's since then
    exercises=(
        Exercise("air_data", 15.0, AIR_DATA),
        Exercise("body_force", 20.0, BODY_FORCE),
        Exercise("state_rate", 15.0, STATE_RATE),
        Exercise("rk4_step", 10.0, RK4, through="step_linear"),
        Exercise("trim", 15.0, TRIM),
    ),
    rubric=(
        Criterion(
            "turn",
            11.0,
            "Track on the dotted circle, radius within 3 % of V^2 / (g tan bank); "
            "height stays within 0.5 m.",
        ),
        Criterion(
            "turn_reading",
            4.0,
            "About 4 m to +y in a round, less than the wind's 6 m: ground speed is held.",
        ),
        Criterion(
            "q1",
            5.0,
            "Lift 1/cos(bank) times the weight: more alpha, more elevator; "
            "induced drag with its square.",
        ),
        Criterion(
            "q2",
            5.0,
            "Same turn through the air, the circle drifts with it; "
            "what the pilot must do at a wall.",
        ),
    ),
    constants={"down_thrust_deg": (1.0, 4.0, 1)},
)
