"""Inverse maps: a model with effects -> its design in still air, its wind, commands, true poses.

A model's effects act in four places. A controller is designed on the forces and moments alone and
undoes the other three where they act: the wind in the reference, the command map on the way to the
servos, the measurement map on the way from the camera.
"""

import math
from dataclasses import replace
from typing import Any

import numpy as np

from falconwing_kit.aircraft.model import Model
from falconwing_kit.aircraft.terms import Flow
from falconwing_kit.core.checks import Array, InputError
from falconwing_kit.core.frames import GRAVITY
from falconwing_kit.core.messages import CONTROL_PERIOD_S, State

COMMAND_GRID = np.linspace(-1.5, 1.5, 301)  # commands at which a command map is tabulated
SETTLED_ROWS = 8  # rows of one command, after which a map with memory is in its steady state
POSE_ITERATIONS = 8  # of the fixed point; each leaves about the tilt's size [rad] of the last error
KIT_SPEED = 7.0  # [m/s], the paper's minimum speed of its aircraft, and its speed indoors


def design_model(model: Model) -> Model:
    """The model in still air and without effects on commands and poses, for trims and gains.

    Delays and lags that effects add become part of the model's own, and so does the mean delay of a
    command map with memory.
    """
    if not model.winds and not model.effects:
        return model
    delay, lag, series = model.added_input_map(model.K)
    delay += _memory_delay(model)
    values = dict(model.values)
    if (delay, lag, series) != (0.0, 0.0, 0.0):
        values["delay"] = max(values.get("delay", 0.0) + delay, 0.0)
        values["lag"] = max(values.get("lag", 0.0) + lag, 0.0) + max(series, 0.0)
    return replace(model, winds=(), values=values, effects=())


def _memory_delay(model: Model) -> float:
    """Mean delay [s] of the command maps: the area between a step of the elevator and the answer.

    Zero for a bias and a dead band, which have no memory.
    """
    maps = [effect.command_map for effect in model.effects if effect.command_map]
    if not maps:
        return 0.0
    t = CONTROL_PERIOD_S * np.arange(4.0 * SETTLED_ROWS)
    commands, K = np.zeros((len(t), 4)), model.K
    commands[2 * SETTLED_ROWS :, 2] = 1.0
    for command_map in maps:
        commands = command_map(t, commands, K)
    answer = commands[2 * SETTLED_ROWS - 1 :, 2]
    share = (answer[1:] - answer[0]) / (answer[-1] - answer[0])
    return float(np.sum(1.0 - share)) * CONTROL_PERIOD_S


def wind_velocity(model: Model, p_world: Array, t: float) -> Array:
    """The model's wind (3,) in world axes at a place (3,) [m] and a time [s], in m/s."""
    K, (x, y, height) = model.K, map(float, p_world)
    total = np.zeros(3)
    for wind in model.winds:
        total += np.array(wind.evaluate(x, y, height, t, K), np.float64)
    return total


def ground_speed(airspeed: float, along: Array, wind: Array) -> float:
    """Speed over the floor on a track, the wind triangle |V_g d - w| = V solved for V_g.

    V_g = d.w + sqrt((d.w)^2 + V^2 - |w|^2) [Beard & McLain, Small Unmanned Aircraft, sec. 2.4].

    Args:
        airspeed: V, > 0 [m/s].
        along: d (3,), unit vector of the track.
        wind: w (3,) [m/s].

    Returns:
        V_g [m/s], at least a fifth of V where the wind is as fast as the aircraft.
    """
    ahead = float(along @ wind)
    root = math.sqrt(max(ahead**2 + airspeed**2 - float(wind @ wind), 0.0))
    return max(ahead + root, 0.2 * airspeed)


class CommandMap:
    """Commands <-> control positions of a model's effects on commands, in the steady state.

    Each channel is tabulated alone and interpolated, so that a bias is inverted exactly and a dead
    band is passed over: positions inside it lie next to its edges.
    """

    def __init__(self, model: Model) -> None:
        """Tabulate the command maps of the model's effects."""
        maps = [effect.command_map for effect in model.effects if effect.command_map]
        self.is_identity = not maps
        if self.is_identity:
            return
        rows = np.repeat(COMMAND_GRID, SETTLED_ROWS)
        t, commands = CONTROL_PERIOD_S * np.arange(float(len(rows))), np.tile(rows, (4, 1)).T
        K: Any = model.K
        for command_map in maps:
            commands = command_map(t, commands, K)
        # (301, 4), not decreasing, as an inverse requires.
        self._positions = np.maximum.accumulate(commands[SETTLED_ROWS - 1 :: SETTLED_ROWS])

    def positions(self, commands: Array) -> Array:
        """(..., 4) control positions of commands (..., 4) that are given for long."""
        if self.is_identity:
            return commands
        tables = [(COMMAND_GRID, column) for column in self._positions.T]
        return _interpolate(commands, tables)

    def commands(self, positions: Array) -> Array:
        """(..., 4) commands that lead to positions (..., 4), not limited to -1..1."""
        if self.is_identity:
            return positions
        tables = [(column, COMMAND_GRID) for column in self._positions.T]
        return _interpolate(positions, tables)


def _interpolate(values: Array, tables: list[tuple[Array, Array]]) -> Array:
    columns = np.moveaxis(np.asarray(values, np.float64), -1, 0)
    pairs = zip(columns, tables, strict=True)
    return np.stack([np.interp(column, x, y) for column, (x, y) in pairs], axis=-1)


def true_state(model: Model, measured: State) -> State:
    """A measured state with the pose that the model's measurement maps turn into the measured one.

    Fixed point of pose = measured - (map(pose) - pose); velocities and rates stay as measured.
    """
    if not any(effect.measurement_map for effect in model.effects):
        return measured
    seen = np.array([*measured.p_world, measured.roll, measured.pitch, measured.yaw])
    pose, K = seen, model.K
    for _ in range(POSE_ITERATIONS):
        pose = seen - (model.measured_pose(pose, K) - pose)
    return replace(
        measured,
        p_world=pose[:3],
        roll=float(pose[3]),
        pitch=float(pose[4]),
        yaw=float(pose[5]),
    )


def similar_speed(model: Model, kit: Model) -> float:
    """Speed at which an aircraft flies level at the angle of attack of the kit's aircraft at 7 m/s.

    Lift equals weight, V^2 c(alpha) = g, with alpha from the kit's model and c from this one
    [Beard & McLain, eq. 4.6]; so similar aircraft fly at similar lift coefficients.

    Args:
        model: any aircraft; its wind does not count.
        kit: the kit's own.

    Returns:
        [m/s], rounded to 1 cm/s, far below what a fit resolves; 7 for the kit's aircraft.

    Raises:
        InputError: the model has no lift there.
    """
    low, high = -0.3, 0.5  # rad; bisection, lift grows with the angle of attack
    for _ in range(50):
        alpha = 0.5 * (low + high)
        low, high = (low, alpha) if _lift(kit, KIT_SPEED, alpha) > GRAVITY else (alpha, high)
    speed = KIT_SPEED
    for _ in range(20):  # one step where lift goes with V^2
        lift = _lift(model, speed, alpha)
        if not lift > 0.0:
            raise InputError(
                f"model: expected lift at an angle of attack of {math.degrees(alpha):.1f} deg, got"
                f" {lift:.2g} m/s^2; check the model's values"
            )
        speed *= math.sqrt(GRAVITY / lift)
    return round(speed, 2)


def _lift(model: Model, speed: float, alpha: float) -> float:
    """Lift per mass [m/s^2] at a speed [m/s] and angle of attack [rad], controls neutral, 2 m up.

    Rates and sideslip zero.
    """
    s, c = math.sin(alpha), math.cos(alpha)
    air = Flow(
        airspeed=speed, alpha=alpha, beta=0.0, u=speed * c, v=0.0, w=speed * s, p=0.0, q=0.0, r=0.0,
        px=0.0, py=0.0, height=2.0, time=0.0, throttle=0.0, aileron=0.0, elevator=0.0, rudder=0.0,
    )  # fmt: skip
    K = model.K
    loads = [term.evaluate(air, K) for term in model.terms]
    forward, down = (sum(float(load[i]) for load in loads) for i in (0, 2))
    return forward * s - down * c
