"""Lab 4, hidden: random flights, and the same physics by SciPy's rotations and linear systems."""

from collections.abc import Mapping
from functools import partial
from typing import Any

import given
import numpy as np

from falconwing_kit.aircraft import step_batch
from falconwing_kit.core import GRAVITY
from falconwing_kit.tools.grading import Course, Judge, Values

Array = np.ndarray
FLIP = np.diag([1.0, -1.0, -1.0])


def judges(course: Course) -> Mapping[str, tuple[Judge, ...]]:
    """The hidden cases of each exercise for one course."""
    tilt = float(np.radians(course.constants["down_thrust_deg"]))
    return {
        "air_data": (Values(_draw_flight, _air_data, cases=12),),
        "body_force": (Values(_draw_force, partial(_body_force, tilt=tilt), cases=12),),
        "state_rate": (Values(_draw_motion, _state_rate, cases=12),),
        "rk4_step": (Values(_draw_step, _step, cases=8, rtol=1e-10, atol=1e-12),),
        "trim": (Values(_draw_climb, partial(_trim, tilt=tilt), cases=12, rtol=1e-6, atol=1e-7),),
    }


def _turn(state: Array) -> Any:
    """scipy's rotation from body to north-east-down axes; FLIP goes on from there."""
    from scipy.spatial.transform import Rotation

    return Rotation.from_euler("ZYX", [state[4], state[3], state[5]])


def _draw_state(rng: np.random.Generator) -> Array:
    """A state with at most 0.6 rad of pitch and 1.2 rad of roll, flying roughly along its nose."""
    attitude = [rng.uniform(-0.6, 0.6), rng.uniform(-3.1, 3.1), rng.uniform(-1.2, 1.2)]
    state = np.concatenate([rng.uniform(-8.0, 8.0, 2), [2.0], attitude, np.zeros(3)])
    v_body = np.array([rng.uniform(5.0, 10.0), *rng.uniform(-1.5, 1.5, 2)])
    state[6:] = FLIP @ _turn(state).apply(v_body)
    return state


def _draw_flight(rng: np.random.Generator) -> tuple[Any, ...]:
    return _draw_state(rng), rng.uniform(-1.5, 1.5, 3)


def _air_data(state: Array, wind_world: Array) -> Array:
    u, v, w = _turn(state).inv().apply(FLIP @ (state[6:] - wind_world))
    return np.array([np.linalg.norm([u, v, w]), np.arctan2(w, u), np.arctan2(v, np.hypot(u, w))])


def _draw_K(rng: np.random.Generator) -> dict[str, float]:
    return {name: value * rng.uniform(0.8, 1.2) for name, value in given.K.items()}


def _draw_force(rng: np.random.Generator) -> tuple[Any, ...]:
    air = np.array([rng.uniform(5.0, 11.0), rng.uniform(-0.1, 0.25), rng.uniform(-0.3, 0.3)])
    return air, np.array([rng.uniform(0.2, 1.0), *rng.uniform(-1.0, 1.0, 3)]), _draw_K(rng)


def _body_force(air: Array, command: Array, K: Mapping[str, float], tilt: float) -> Array:
    """Wind axes to body axes by two rotations, thrust by one."""
    from scipy.spatial.transform import Rotation

    V, alpha, beta = air
    c = K["cL_0"] + K["cL_alpha"] * alpha
    in_path = Rotation.from_euler("z", beta).apply(
        [-(K["cD_0"] + K["cD_induced"] * c * c), 0.0, 0.0]
    ) - [0.0, 0.0, c]
    thrust = Rotation.from_euler("y", -tilt).apply(
        [(K["kT"] - K["kTV"] * V) * command[0], 0.0, 0.0]
    )
    aerodynamic = Rotation.from_euler("y", -alpha).apply(in_path) + np.array(
        [0.0, K["cY_beta"] * beta, 0.0]
    )
    return np.asarray(V * V * aerodynamic + thrust)


def _draw_motion(rng: np.random.Generator) -> tuple[Any, ...]:
    return _draw_state(rng), rng.uniform(-12.0, 12.0, 3), rng.uniform(-2.0, 2.0, 3)


def _state_rate(state: Array, force_body: Array, rates_body: Array) -> Array:
    """Angle rates from the linear system that says what body rates they make."""
    pitch, roll = state[3], state[5]
    makes = np.array([  # columns: roll rate, pitch rate, yaw rate
        [1.0, 0.0, -np.sin(pitch)],
        [0.0, np.cos(roll), np.sin(roll) * np.cos(pitch)],
        [0.0, -np.sin(roll), np.cos(roll) * np.cos(pitch)],
    ])  # fmt: skip
    roll_dot, pitch_dot, yaw_dot = np.linalg.solve(makes, rates_body)
    acceleration = FLIP @ _turn(state).apply(force_body) - [0.0, 0.0, GRAVITY]
    return np.concatenate([state[6:], [pitch_dot, yaw_dot, roll_dot], acceleration])


def _draw_step(rng: np.random.Generator) -> tuple[Any, ...]:
    A, B = rng.normal(size=(3, 3)), rng.normal(size=(3, 2))
    return (
        A,
        B,
        rng.normal(size=3),
        rng.normal(size=2),
        rng.normal(size=2),
        float(rng.uniform(0.2, 0.6)),
    )


def _step(
    A: Array, B: Array, x: Array, u_now: Array, u_next: Array, dt: float
) -> tuple[Array, Array]:
    """The kit's own step, which takes the middle of the input and half of its change.

    x stays as it was.
    """

    def rates(time: float, x: Array, u: Array, K: None) -> Array:
        return A @ x + B @ u

    middle, slope = 0.5 * (u_now + u_next)[:, None], 0.5 * (u_next - u_now)[:, None]
    return step_batch(rates, None, 0.0, x[:, None], middle, dt, slope)[:, 0], x.copy()


def _draw_climb(rng: np.random.Generator) -> tuple[Any, ...]:
    return float(rng.uniform(5.5, 9.0)), float(rng.uniform(-0.3, 0.3)), _draw_K(rng)


def _trim(airspeed: float, climb_angle: float, K: Mapping[str, float], tilt: float) -> Array:
    """scipy's root of the total force in the world and of the pitch rate."""
    from scipy.optimize import root
    from scipy.spatial.transform import Rotation

    def unbalanced(unknown: Array) -> Array:
        alpha, throttle, elevator = unknown
        force = _body_force(
            np.array([airspeed, alpha, 0.0]), np.array([throttle, 0, 0, 0]), K, tilt
        )
        in_world = FLIP @ Rotation.from_euler("y", climb_angle + alpha).apply(force) - [
            0.0,
            0.0,
            GRAVITY,
        ]
        return np.array(
            [in_world[0], in_world[2], K["M_0"] + K["M_de"] * elevator + K["M_alpha"] * alpha]
        )

    return np.asarray(root(unbalanced, [0.08, 0.4, 0.0], tol=1e-12).x)
