"""Sparse terms: named coordinates -> effects of one coefficient each, a library to select from.

Each is one textbook channel (drag, side force, lift, thrust; rolling, pitching, yawing moment)
times one regressor in named coordinates, a component of the air's velocity, a change of one control
input, or a constant error of the pose: roll moment with rudder is dp/dt = k V^2 rudder. A few of
them, selected on a flight, are the discrepancy between it and its model when no catalogue effect
accounts for it (`gap/discrepancy.py`) [Brunton, Proctor & Kutz 2016; Klein & Morelli, ch. 5:
stepwise regression].

Coefficients are dimensional, as in `terms.py`: none depends on a reference speed or span, so the
same library serves a 30 g and a 25 kg aircraft. Scales that have to be found (the height over which
something decays, the wavelength of a wind) are shape parameters.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from math import pi
from typing import Any

import numpy as np

from falconwing_kit.aircraft.effect import Effect
from falconwing_kit.aircraft.terms import Flow, Loads, Parameter, drag_loads, lift_loads
from falconwing_kit.core.checks import Array

BOUND = 1e4  # of a coefficient; wide, the flight decides
DECAY_HEIGHTS_M = (0.15, 0.4, 1.0, 2.5)  # where a search starts: spans of 0.3 to 5 m
# Wavelengths tried, by how many fit into the area flown: half a wave apart, so none is missed.
WAVES_PER_AREA = tuple(0.5 * k for k in range(1, 13))
STICKS = ("throttle", "aileron", "elevator", "rudder")


@dataclass(frozen=True)
class Regressor:
    """One coordinate that a load may be proportional to."""

    name: str
    formula: str  # as printed in an equation
    value: Callable[[Flow], Any]
    length: int  # powers of its unit: m^length s^time rad^angle
    time: int
    angle: int = 0
    powered: bool = False  # by the propeller: a force is along the nose instead of the flight path

    @property
    def is_rate(self) -> bool:
        """Whether it is proportional to a body rate."""
        return self.name.endswith("rate")


def _of_stick(stick: str) -> tuple[Regressor, ...]:
    """What a load may have to do with one control surface."""

    def linear(a: Flow) -> Any:
        return a.airspeed * a.airspeed * getattr(a, stick)

    def slow(a: Flow) -> Any:
        return a.airspeed * getattr(a, stick)

    def curved(a: Flow) -> Any:
        return a.airspeed * a.airspeed * getattr(a, stick) * np.abs(getattr(a, stick))

    def size(a: Flow) -> Any:
        return a.airspeed * a.airspeed * np.abs(getattr(a, stick))

    def at_alpha(a: Flow) -> Any:
        return a.airspeed * a.airspeed * a.alpha * getattr(a, stick)

    def in_wash(a: Flow) -> Any:
        return a.throttle * getattr(a, stick)

    return (
        Regressor(stick, f"V^2 {stick}", linear, 2, -2),
        Regressor(f"{stick} times airspeed", f"V {stick}", slow, 1, -1),
        Regressor(f"{stick} squared", f"V^2 {stick} |{stick}|", curved, 2, -2),
        Regressor(f"size of {stick}", f"V^2 |{stick}|", size, 2, -2),
        Regressor(f"{stick} at angle of attack", f"V^2 alpha {stick}", at_alpha, 2, -2, 1),
        Regressor(f"throttle and {stick}", f"throttle {stick}", in_wash, 0, 0, 0, True),
    )


# V^2 is written out, since it is also compiled.
REGRESSORS: tuple[Regressor, ...] = (
    Regressor("", "", lambda a: 1.0 + 0.0 * a.airspeed, 0, 0),
    Regressor("airspeed", "V", lambda a: a.airspeed, 1, -1),
    Regressor("airspeed squared", "V^2", lambda a: a.airspeed * a.airspeed, 2, -2),
    Regressor(
        "angle of attack", "V^2 alpha", lambda a: a.airspeed * a.airspeed * a.alpha, 2, -2, 1
    ),
    Regressor(
        "angle of attack squared", "V^2 alpha^2",
        lambda a: a.airspeed * a.airspeed * a.alpha * a.alpha, 2, -2, 2,
    ),
    Regressor("sideslip", "V^2 beta", lambda a: a.airspeed * a.airspeed * a.beta, 2, -2, 1),
    Regressor(
        "size of sideslip", "V^2 |beta|",
        lambda a: a.airspeed * a.airspeed * np.abs(a.beta), 2, -2, 1,
    ),
    Regressor(
        "sideslip squared", "V^2 beta^2",
        lambda a: a.airspeed * a.airspeed * a.beta * a.beta, 2, -2, 2,
    ),
    Regressor(
        "sideslip at angle of attack", "V^2 alpha beta",
        lambda a: a.airspeed * a.airspeed * a.alpha * a.beta, 2, -2, 2,
    ),
    *_of_stick("aileron"), *_of_stick("elevator"), *_of_stick("rudder"),
    Regressor("roll rate", "V p", lambda a: a.airspeed * a.p, 1, -2, 1),
    Regressor("pitch rate", "V q", lambda a: a.airspeed * a.q, 1, -2, 1),
    Regressor("yaw rate", "V r", lambda a: a.airspeed * a.r, 1, -2, 1),
    Regressor("pitch and yaw rate", "q r", lambda a: a.q * a.r, 0, -2, 2),
    Regressor("roll and yaw rate", "p r", lambda a: a.p * a.r, 0, -2, 2),
    Regressor("roll and pitch rate", "p q", lambda a: a.p * a.q, 0, -2, 2),
    Regressor("throttle", "throttle", lambda a: a.throttle, 0, 0, 0, True),
    Regressor("throttle times airspeed", "V throttle", lambda a: a.airspeed * a.throttle,
              1, -1, 0, True),
    Regressor("throttle squared", "throttle^2", lambda a: a.throttle * a.throttle, 0, 0, 0, True),
    Regressor("throttle and angle of attack", "throttle alpha", lambda a: a.throttle * a.alpha,
              0, 0, 1, True),
    Regressor("throttle and sideslip", "throttle beta", lambda a: a.throttle * a.beta,
              0, 0, 1, True),
    Regressor("throttle and pitch rate", "throttle q", lambda a: a.throttle * a.q, 0, -1, 1, True),
    Regressor("throttle and yaw rate", "throttle r", lambda a: a.throttle * a.r, 0, -1, 1, True),
    Regressor("time", "V^2 t", lambda a: a.airspeed * a.airspeed * a.time, 2, -1),
    Regressor("throttle and time", "throttle t", lambda a: a.throttle * a.time, 0, 1, 0, True),
    Regressor("place along x", "V^2 x", lambda a: a.airspeed * a.airspeed * a.px, 3, -2),
    Regressor("place along y", "V^2 y", lambda a: a.airspeed * a.airspeed * a.py, 3, -2),
)  # fmt: skip
# Near the ground the decay height is a shape parameter of its own.
NEAR_GROUND = Regressor(
    "nearness to the ground", "V^2 exp(-h/d)", lambda a: a.airspeed * a.airspeed, 2, -2
)

# Channel -> its left side in an equation, and the load of a size.
Direction = Callable[[Flow, Any], Loads]


def _along_flow(air: Flow, size: Any) -> Loads:
    return drag_loads(air, size / air.airspeed)


def _along_nose(air: Flow, size: Any) -> Loads:
    return size, 0.0, 0.0, 0.0, 0.0, 0.0


def _along_wing(air: Flow, size: Any) -> Loads:
    return 0.0, size, 0.0, 0.0, 0.0, 0.0


def _about_nose(air: Flow, size: Any) -> Loads:
    return 0.0, 0.0, 0.0, size, 0.0, 0.0


def _about_wing(air: Flow, size: Any) -> Loads:
    return 0.0, 0.0, 0.0, 0.0, size, 0.0


def _about_belly(air: Flow, size: Any) -> Loads:
    return 0.0, 0.0, 0.0, 0.0, 0.0, size


CHANNELS: dict[str, tuple[str, Direction]] = {
    "drag": ("D/m", _along_flow),
    "side force": ("Y/m", _along_wing),
    "lift": ("L/m", lift_loads),
    "roll moment": ("dp/dt", _about_nose),
    "pitch moment": ("dq/dt", _about_wing),
    "yaw moment": ("dr/dt", _about_belly),
}


def _unit(length: int, time: int, angle: int) -> str:
    """Unit of a coefficient from its powers of m, s and rad."""
    powers = {"m": length, "s": time, "rad": angle}

    def product(sign: int) -> list[str]:
        return [
            unit if sign * power == 1 else f"{unit}^{sign * power}"
            for unit, power in powers.items()
            if sign * power > 0
        ]

    above, below = " ".join(product(1)) or "1", product(-1)
    if not below:
        return "-" if above == "1" else above
    return f"{above}/{below[0]}" if len(below) == 1 else f"{above}/({' '.join(below)})"


def _identifier(name: str) -> str:
    return name.replace(" ", "_")


def _sentence(name: str, formula: str) -> str:
    return f"The model lacks {name}: {formula}."


def formula(effect: Effect) -> str:
    """Equation of a sparse effect with k (or a, b, and a length d, l) for its parameters."""
    return effect.physics.split(": ", 1)[1].removesuffix(".")


def _load(channel: str, regressor: Regressor) -> Effect:
    """A force or moment in one channel, in proportion to one regressor."""
    left, direction = CHANNELS[channel]
    if channel == "drag" and regressor.powered:
        channel, left, direction = "thrust", "T/m", _along_nose
    rotational, value = channel.endswith("moment"), regressor.value
    # m/s^2 or rad/s^2 over the regressor's unit; the radian of an angular acceleration counts only
    # against that of a body rate, as in terms.py: L_da in 1/m^2, L_beta in 1/(m^2 rad), L_p in 1/m.
    angle = int(rotational and regressor.angle > 0 and regressor.is_rate) - regressor.angle
    unit = _unit((not rotational) - regressor.length, -2 - regressor.time, angle)
    name = f"{channel} with {regressor.name}" if regressor.name else f"constant {channel}"
    parameter = _identifier(name.replace(" with ", " "))
    coefficient = Parameter(
        parameter, 0.01, -BOUND, BOUND, unit, f"{left} per {regressor.formula or 'unit'}"
    )
    decay = f"{parameter}_decay"

    def evaluate(air: Flow, K: Any) -> Loads:
        return direction(air, getattr(K, parameter) * value(air))

    def evaluate_near_ground(air: Flow, K: Any) -> Loads:
        share = np.exp(-np.maximum(air.height, 0.0) / getattr(K, decay))
        return direction(air, getattr(K, parameter) * value(air) * share)

    equation = f"{left} = ... + k {regressor.formula}".rstrip()
    if regressor is not NEAR_GROUND:
        return Effect(
            name, _sentence(name, equation), (coefficient,), loads=evaluate,
            gradual=regressor.name.endswith("time"),
        )  # fmt: skip
    height = Parameter(decay, DECAY_HEIGHTS_M[0], 0.05, 10.0, "m", "height over which it decays")
    return Effect(
        name, _sentence(name, equation), (coefficient, height), loads=evaluate_near_ground,
        starts=tuple({decay: d} for d in DECAY_HEIGHTS_M[1:]), shape=(decay,),
    )  # fmt: skip


SPARSE_LOADS: tuple[Effect, ...] = tuple(
    _load(channel, regressor) for channel in CHANNELS for regressor in (*REGRESSORS, NEAR_GROUND)
)


# Air that moves
UNIT_VECTORS = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))
WIND_NAMES = ("wind along x", "wind along y", "updraught")
WIND_FACTORS: dict[str, tuple[str, str, Callable[..., Any]]] = {
    "": ("", "m/s", lambda px, py, height, time: 1.0),
    " growing with height": (" h", "1/s", lambda px, py, height, time: height),
    " growing with time": (" t", "m/s^2", lambda px, py, height, time: time),
}


def _wind(axis: int, factor: str) -> Effect:
    """One component of the air's velocity, uniform, or growing with height or time."""
    symbol, unit, value = WIND_FACTORS[factor]
    ex, ey, ez = UNIT_VECTORS[axis]
    name = WIND_NAMES[axis] + factor
    parameter = _identifier(name.replace("wind along", "air along"))

    def field(px: Any, py: Any, height: Any, time: Any, K: Any) -> tuple[Any, Any, Any]:
        speed = getattr(K, parameter) * value(px, py, height, time)
        return speed * ex, speed * ey, speed * ez

    along = "xyz"[axis]
    coefficient = Parameter(
        parameter, 0.05, -50.0, 50.0, unit, f"air's velocity along world {along}"
    )
    return Effect(
        name, _sentence(name, f"w_{along} = ... + k{symbol}"), (coefficient,),
        wind_field=field, gradual=factor.endswith("time"),
    )  # fmt: skip


def _wave(axis: int, along: int) -> Effect:
    """One component of the air's velocity as a sine over one coordinate of the place."""
    name = f"{WIND_NAMES[axis]} in waves over {'xy'[along]}"
    stem = _identifier(f"wave {'xyz'[axis]} over {'xy'[along]}")
    sine, cosine, length = (f"{stem}_{part}" for part in ("sin", "cos", "length"))
    ex, ey, ez = UNIT_VECTORS[axis]

    def field(px: Any, py: Any, height: Any, time: Any, K: Any) -> tuple[Any, Any, Any]:
        phase = 2.0 * pi / getattr(K, length) * (px * (1 - along) + py * along)
        speed = getattr(K, sine) * np.sin(phase) + getattr(K, cosine) * np.cos(phase)
        return speed * ex, speed * ey, speed * ez

    def scan(low: Array, high: Array) -> Sequence[dict[str, float]]:
        extent = max(float(high[along] - low[along]), 1.0)
        return [{length: extent / waves} for waves in WAVES_PER_AREA]

    phase = f"(2 pi {'xy'[along]}/l)"
    return Effect(
        name, _sentence(name, f"w_{'xyz'[axis]} = ... + a sin{phase} + b cos{phase}"),
        (
            Parameter(sine, 0.05, -50.0, 50.0, "m/s", "amplitude of its sine"),
            Parameter(cosine, 0.05, -50.0, 50.0, "m/s", "amplitude of its cosine"),
            Parameter(length, 10.0, 0.5, 5000.0, "m", "wavelength"),
        ),
        wind_field=field, scan_points=scan, shape=(length,),
    )  # fmt: skip


SPARSE_WINDS: tuple[Effect, ...] = (
    *(_wind(axis, factor) for axis in range(3) for factor in WIND_FACTORS),
    *(_wave(axis, along) for axis in range(3) for along in range(2)),
)


# Control inputs
def delayed(t: Array, commands: Array, delay: float) -> Array:
    """One control input (N,) as it was a time ago [s], interpolated between rows."""
    return np.asarray(np.interp(t - delay, t, commands))


def dead_band(t: Array, command: Array, band: float) -> Array:
    """u less its part within the band, as of a linkage that must be taken up first."""
    return command - np.clip(command, -abs(band), abs(band)) * np.sign(band)


def backlash(t: Array, command: Array, play: float) -> Array:
    """A linkage with play: the surface follows only when the stick has crossed it.

    It stands play / 2 behind the direction of the last movement [Tao & Kokotovic, Adaptive Control
    of Systems with Actuator and Sensor Nonlinearities, ch. 2]. A negative play leads.
    """
    half = 0.5 * abs(play)
    position, positions = 0.0, []
    for low, high in zip((command - half).tolist(), (command + half).tolist(), strict=True):
        position = low if position < low else high if position > high else position
        positions.append(position)
    return command + np.sign(play) * (np.array(positions) - command)


InputChange = Callable[[Array, Array, float], Array]  # (t (N,), one input (N,), size) -> (N,)
INPUT_CHANGES: dict[str, tuple[str, str, float, float, InputChange]] = {
    # name -> formula, unit, where a search starts, bound, the change
    "bias": ("u + k", "-", 0.02, 1.0, lambda t, u, k: u + k),
    "gain": ("u (1 + k)", "-", 0.05, 3.0, lambda t, u, k: u * (1.0 + k)),
    "curve": ("u + k (u |u| - u)", "-", 0.1, 5.0, lambda t, u, k: u + k * (u * np.abs(u) - u)),
    "dead band": ("u without its part within k", "-", 0.04, 0.8, dead_band),
    "play": ("u with a play of k", "-", 0.04, 1.0, backlash),
    "delay": ("u(t - k)", "s", 0.03, 1.0, delayed),
}


def _input(column: int, change: str) -> Effect:
    """A change of one control input."""
    stick = STICKS[column]
    changed, unit, start, bound, mapped = INPUT_CHANGES[change]
    parameter = _identifier(f"{stick} {change} changed")

    def command_map(t: Array, commands: Array, K: Any) -> Array:
        size = getattr(K, parameter)
        if size == 0.0:
            return commands
        moved = commands.copy()
        moved[:, column] = mapped(t, commands[:, column], size)
        return moved

    name = f"{change} of the {stick}"
    return Effect(
        name, _sentence(name, f"{stick} = {changed}"),
        (Parameter(parameter, start, -bound, bound, unit, f"{change} of the {stick}"),),
        command_map=command_map,
    )  # fmt: skip


SPARSE_INPUTS: tuple[Effect, ...] = tuple(
    _input(column, change) for column in range(4) for change in INPUT_CHANGES
)


# Poses
def _pose_offset(axis: int) -> Effect:
    """A constant error of one angle of the pose."""
    angle = ("roll", "pitch", "yaw")[axis]
    name, parameter = f"offset of the measured {angle}", f"measured_{angle}_offset"

    def measurement_map(pose: Array, K: Any) -> Array:
        offset = getattr(K, parameter)
        return np.stack([*pose[: 3 + axis], pose[3 + axis] + offset, *pose[4 + axis :]])

    return Effect(
        name, _sentence(name, f"measured {angle} = {angle} + k"),
        (Parameter(parameter, 0.01, -1.0, 1.0, "rad", f"constant error of the {angle}"),),
        measurement_map=measurement_map,
    )  # fmt: skip


SPARSE_POSES: tuple[Effect, ...] = tuple(_pose_offset(axis) for axis in range(3))

SPARSE_EFFECTS: tuple[Effect, ...] = (*SPARSE_LOADS, *SPARSE_WINDS, *SPARSE_INPUTS, *SPARSE_POSES)

# Sparse effect -> what the textbooks call it (Beard & McLain ch. 4; Phillips ch. 2); an effect of
# the catalogue names the sparse terms of its form itself (`Effect.same_form`).
USUAL_NAMES: dict[str, str] = {
    "lift with airspeed squared": "cL_0, lift at zero angle of attack (C_L_0)",
    "lift with angle of attack": "cL_alpha, lift slope (C_L_alpha)",
    "lift with elevator": "cL_de, lift of the elevator (C_L_de)",
    "lift with pitch rate": "cL_q, lift due to pitch rate (C_L_q)",
    "drag with airspeed squared": "drag at zero lift (C_D_0)",
    "drag with angle of attack": "cD_alpha, drag due to angle of attack (C_D_alpha)",
    "drag with angle of attack squared": "cD_induced, induced drag",
    "drag with sideslip squared": "cD_beta, drag in a sideslip (C_D_beta)",
    "drag with size of elevator": "cD_de, drag of the elevator (C_D_de)",
    "drag with size of aileron": "cD_da, drag of the ailerons (C_D_da)",
    "drag with size of rudder": "cD_dr, drag of the rudder (C_D_dr)",
    "side force with sideslip": "cY_beta, side force of sideslip (C_Y_beta)",
    "side force with aileron": "cY_da, side force of the ailerons (C_Y_da)",
    "side force with rudder": "cY_dr, side force of the rudder (C_Y_dr)",
    "side force with roll rate": "cY_p, side force due to roll rate (C_Y_p)",
    "side force with yaw rate": "cY_r, side force due to yaw rate (C_Y_r)",
    "roll moment with airspeed squared": "L_0, rolling moment at zero angles (C_l_0)",
    "roll moment with sideslip": "L_beta, dihedral effect (C_l_beta)",
    "roll moment with aileron": "L_da, rolling moment of the ailerons (C_l_da)",
    "roll moment with rudder": "L_dr, rolling moment of the rudder (C_l_dr)",
    "roll moment with roll rate": "L_p, roll damping (C_l_p)",
    "roll moment with yaw rate": "L_r, roll due to yaw rate (C_l_r)",
    "roll moment with pitch and yaw rate": "Jx, inertia coupling (Iyy - Izz)/Ixx",
    "pitch moment with airspeed squared": "M_0, pitching moment at zero angles (C_m_0)",
    "pitch moment with angle of attack": "M_alpha, pitch stiffness (C_m_alpha)",
    "pitch moment with elevator": "M_de, pitching moment of the elevator (C_m_de)",
    "pitch moment with pitch rate": "M_q, pitch damping (C_m_q)",
    "pitch moment with throttle": "a thrust line beside the centre of gravity (C_m_dt)",
    "pitch moment with throttle and elevator": "propeller wash over the elevator",
    "pitch moment with throttle and yaw rate": "gyroscopic moment of the propeller",
    "pitch moment with roll and yaw rate": "Jy, inertia coupling (Izz - Ixx)/Iyy",
    "yaw moment with airspeed squared": "N_0, yawing moment at zero angles (C_n_0)",
    "yaw moment with sideslip": "N_beta, weathercock stiffness (C_n_beta)",
    "yaw moment with aileron": "N_da, adverse yaw (C_n_da)",
    "yaw moment with rudder": "N_dr, yawing moment of the rudder (C_n_dr)",
    "yaw moment with roll rate": "N_p, yaw due to roll rate (C_n_p)",
    "yaw moment with yaw rate": "N_r, yaw damping (C_n_r)",
    "yaw moment with throttle": "P factor of the propeller",
    "yaw moment with throttle and rudder": "propeller wash over the rudder",
    "yaw moment with throttle and pitch rate": "gyroscopic moment of the propeller",
    "yaw moment with roll and pitch rate": "Jz, inertia coupling (Ixx - Iyy)/Izz",
    "thrust with throttle": "kT, thrust at full throttle",
    "thrust with throttle times airspeed": "kTV, thrust lost with speed",
    "updraught": "vertical wind",
    "wind along x growing with height": "wind shear",
    "wind along y growing with height": "wind shear",
    **{f"play of the {stick}": "backlash of the linkage" for stick in STICKS},
    "offset of the measured yaw": "a camera mount turned sideways",
}
