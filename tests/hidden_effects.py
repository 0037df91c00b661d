"""Hidden effects: an aircraft and a size -> what changes in JSBSim, on the sticks or in the
measured poses.

They act on JSBSim's own properties and share no code with the kit's catalogue; three are in no
catalogue. Sizes have the names of the labelled gap cases where those have one. North is the kit's
+x, east its -y.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from tests.jsbsim_aircraft import (
    EARTH_RADIUS,
    FOOT,
    SEA_LEVEL_DENSITY,
    STEP,
    STICKS,
    Array,
    BeforeStep,
    JsbsimAircraft,
)

Draw = Callable[
    [np.random.Generator, float, JsbsimAircraft], dict[str, Any]
]  # rng, size -> the sizes by name
# s flown before the table begins, so that nothing of the start remains; the battery sags from here
# on
LEAD = 10.0


@dataclass(frozen=True)
class Acting:
    """What an effect changes: the aircraft, something before each step, or how the poses are
    measured.
    """

    aircraft: JsbsimAircraft
    before_step: BeforeStep | None = None
    tilt: tuple[float, float] = (0.0, 0.0)  # camera turned up, and about the nose [rad]
    late: float = 0.0  # s by which the stamps are late


@dataclass(frozen=True)
class HiddenEffect:
    """How an effect's sizes are drawn, how they act, and what they are in the kit's units."""

    act: Callable[[JsbsimAircraft, Any], Acting]
    small: tuple[float, float]  # size that is just visible: at marker noise, at net noise
    plain: float  # size that is plain to see
    draw: Draw
    in_kit: Callable[[JsbsimAircraft, Any], dict[str, float]] = lambda aircraft, size: {}


# Effects on the aircraft
# ------------------------------------------------------------------------------------------


def _wind(aircraft: JsbsimAircraft, size: Any) -> Acting:
    return Acting(aircraft, lambda t, fdm: _blow(fdm, *size["wind"]))


def _blow(fdm: Any, north: float, east: float) -> None:
    fdm["atmosphere/wind-north-fps"], fdm["atmosphere/wind-east-fps"] = (
        float(north) / FOOT,
        float(east) / FOOT,
    )


def _fan_jet(aircraft: JsbsimAircraft, size: Any) -> Acting:
    north, east = size["jet"]

    def before_step(t: float, fdm: Any) -> None:
        x, y = _place(fdm)
        share = np.exp(
            -0.5 * ((x - size["at"][0]) ** 2 + (y - size["at"][1]) ** 2) / size["radius"] ** 2
        )
        _blow(fdm, north * share, east * share)

    return Acting(aircraft, before_step)


def _place(fdm: Any) -> tuple[float, float]:
    return fdm["position/lat-gc-rad"] * EARTH_RADIUS, -fdm["position/long-gc-rad"] * EARTH_RADIUS


def _ground_effect(aircraft: JsbsimAircraft, size: Any) -> Acting:
    def before_step(t: float, fdm: Any) -> None:
        near = size["ge"] * np.exp(-max(fdm["position/h-sl-ft"] * FOOT, 0.0) / 0.5)
        for name in ("CL0", "CLa", "CLde"):
            fdm[f"falcon/{name}"] = getattr(aircraft, name) * (1.0 + near)
        fdm["falcon/k"] = (
            aircraft.k * (1.0 - size["less_drag"] * min(near, 1.0)) / (1.0 + near) ** 2
        )

    return Acting(aircraft, before_step)


def _battery_sag(aircraft: JsbsimAircraft, size: Any) -> Acting:
    def before_step(t: float, fdm: Any) -> None:
        left = 1.0 - size["sag"] * max(t - LEAD, 0.0) / 60.0
        fdm["falcon/thrust"], fdm["falcon/thrust_per_speed"] = (
            aircraft.thrust * left,
            aircraft.thrust_per_speed * left,
        )

    return Acting(aircraft, before_step)


def _propeller_torque(aircraft: JsbsimAircraft, size: Any) -> Acting:
    def before_step(t: float, fdm: Any) -> None:
        moment = _thrust(aircraft, fdm) / (_pressure(fdm) * aircraft.wing_area * aircraft.span)
        fdm["falcon/Cl0"] = aircraft.Cl0 + size["arm_roll"] * moment
        fdm["falcon/Cn0"] = aircraft.Cn0 + size["arm_yaw"] * moment

    return Acting(aircraft, before_step)


def _thrust(aircraft: JsbsimAircraft, fdm: Any) -> float:
    speed = fdm["velocities/vt-fps"] * FOOT
    return float(fdm["falcon/throttle"] * (aircraft.thrust - aircraft.thrust_per_speed * speed))


def _pressure(fdm: Any) -> float:
    return float(0.5 * SEA_LEVEL_DENSITY * max(fdm["velocities/vt-fps"] * FOOT, 1.0) ** 2)


def _adverse_yaw(aircraft: JsbsimAircraft, size: Any) -> Acting:
    def before_step(t: float, fdm: Any) -> None:
        fdm["falcon/Cn0"] = aircraft.Cn0 - size["ady"] * fdm["falcon/aileron"]

    return Acting(aircraft, before_step)


def _stall(aircraft: JsbsimAircraft, size: Any) -> Acting:
    def before_step(t: float, fdm: Any) -> None:
        alpha = fdm["aero/alpha-rad"]
        lost = size["loss"] * aircraft.CLa * max(alpha - size["alpha"], 0.0)
        fdm["falcon/CL0"], fdm["falcon/CD0"] = (
            aircraft.CL0 - lost,
            aircraft.CD0 + lost * np.tan(min(alpha, 1.0)),
        )

    return Acting(aircraft, before_step)


# Effects on the sticks, each as it passes to its servo
# --------------------------------------------------------------


def _on_sticks(aircraft: JsbsimAircraft, change: Callable[[Array], Array]) -> Acting:
    def before_step(t: float, fdm: Any) -> None:
        changed = change(np.array([fdm[f"falcon/{name}-stick"] for name in STICKS]))
        for name, value in zip(STICKS, changed, strict=True):
            fdm[f"falcon/{name}-stick"] = float(value)

    return Acting(aircraft, before_step)


def _actuator_lag(aircraft: JsbsimAircraft, size: Any) -> Acting:
    if not size["in_series"]:
        return Acting(replace(aircraft, servo=1.0 / (1.0 / aircraft.servo + size["lag"])))
    kept, position = np.exp(-STEP / size["lag"]), None

    def change(sticks: Array) -> Array:
        nonlocal position
        position = sticks if position is None else kept * position + (1.0 - kept) * sticks
        return position

    return _on_sticks(aircraft, change)


def _trim_bias(aircraft: JsbsimAircraft, size: Any) -> Acting:
    return _on_sticks(aircraft, lambda sticks: sticks + np.array([0.0, *size["bias"]]))


def _deadband(aircraft: JsbsimAircraft, size: Any) -> Acting:
    band = np.array([-1.0, *3 * [size["band"]]])
    return _on_sticks(aircraft, lambda sticks: np.where(np.abs(sticks) > band, sticks, 0.0))


# Effects that no catalogue holds
# ------------------------------------------------------------------------------------


def _gust_field(aircraft: JsbsimAircraft, size: Any) -> Acting:
    """Air that weaves: a wind that goes as a sine across the hall and is nothing in the mean."""

    def before_step(t: float, fdm: Any) -> None:
        x, y = 2.0 * np.pi * np.array(_place(fdm)) / size["wavelength"]
        _blow(
            fdm, size["gust"] * np.sin(y + size["phase"]), size["gust"] * np.sin(x + size["phase"])
        )

    return Acting(aircraft, before_step)


def _thrust_line(aircraft: JsbsimAircraft, size: Any) -> Acting:
    """The thrust passes above or below the centre of gravity and pitches the aircraft."""

    def before_step(t: float, fdm: Any) -> None:
        force = _pressure(fdm) * aircraft.wing_area * aircraft.chord
        fdm["falcon/Cm0"] = aircraft.Cm0 + size["arm"] * _thrust(aircraft, fdm) / force

    return Acting(aircraft, before_step)


def _elevator_play(aircraft: JsbsimAircraft, size: Any) -> Acting:
    """A loose elevator linkage: it follows only when the stick has crossed the play."""
    position = 0.0

    def change(sticks: Array) -> Array:
        nonlocal position
        position = min(
            max(position, sticks[2] - 0.5 * size["play"]), sticks[2] + 0.5 * size["play"]
        )
        return np.array([sticks[0], sticks[1], position, sticks[3]])

    return _on_sticks(aircraft, change)


# The table of all
# --------------------------------------------------------------------------------------------------


def _force_per_mass(a: JsbsimAircraft) -> float:
    return 0.5 * SEA_LEVEL_DENSITY * a.wing_area / a.mass


def _yaw_per_inertia(a: JsbsimAircraft) -> float:
    return 0.5 * SEA_LEVEL_DENSITY * a.wing_area * a.span / a.Izz


def _named(name: str, signed: bool = False) -> Draw:
    return lambda rng, size, a: {name: size * (float(rng.choice([-1.0, 1.0])) if signed else 1.0)}


def _direction(rng: np.random.Generator, size: float, count: int = 2) -> list[float]:
    drawn = rng.normal(size=count)
    return [float(v) for v in size * drawn / np.linalg.norm(drawn)]


def _draw_jet(rng: np.random.Generator, size: float, a: JsbsimAircraft) -> dict[str, Any]:
    around = rng.uniform(0.0, 2.0 * np.pi)  # its middle lies near one of the circles that are flown
    at = [float(rng.choice([-4.5, 4.5]) + 5.0 * np.cos(around)), float(5.0 * np.sin(around))]
    return {"jet": _direction(rng, size), "at": at, "radius": float(rng.uniform(1.5, 3.0))}


def _whole_steps(seconds: float) -> float:
    return max(round(seconds / STEP), 1) * STEP


EFFECTS: dict[str, HiddenEffect] = {
    "none": HiddenEffect(lambda a, s: Acting(a), (1.0, 1.0), 1.0, lambda rng, size, a: {}),
    "wind": HiddenEffect(
        # m/s north, east
        _wind, (0.05, 0.3), 1.2, lambda rng, size, a: {"wind": _direction(rng, size)},
        lambda a, s: {"wind_x": s["wind"][0], "wind_y": -s["wind"][1]},
    ),
    "fan_jet": HiddenEffect(
        _fan_jet, (0.4, 1.4), 3.0, _draw_jet,  # m/s north, east
        lambda a, s: {
            "jet_x": s["jet"][0], "jet_y": -s["jet"][1],
            "jet_at_x": s["at"][0], "jet_at_y": s["at"][1], "jet_radius": s["radius"],
        },
    ),
    # CL (1 + ge exp(-h / 0.5 m)), and of the induced drag none or some of it less
    "ground_effect": HiddenEffect(
        _ground_effect, (0.2, 0.5), 0.8,
        lambda rng, size, a: {"ge": size, "less_drag": float(rng.uniform(0.0, 1.0))},
        lambda a, s: {"ground_lift": s["ge"]},
    ),
    "extra_drag": HiddenEffect(
        lambda a, s: Acting(replace(a, CD0=a.CD0 + s["dcd"])), (0.015, 0.03), 0.05, _named("dcd"),
        lambda a, s: {"drag_added": _force_per_mass(a) * s["dcd"]},
    ),
    "flap": HiddenEffect(
        lambda a, s: Acting(replace(a, CL0=a.CL0 + s["dcl"], CD0=a.CD0 + s["dcd"])),
        (0.07, 0.12), 0.25,
        lambda rng, size, a: {"dcl": size, "dcd": 0.08 * size},
        lambda a, s: {
            "flap_lift": _force_per_mass(a) * s["dcl"], "flap_drag": _force_per_mass(a) * s["dcd"],
        },
    ),
    "thrust_loss": HiddenEffect(
        lambda a, s: Acting(replace(
            a, thrust=a.thrust * (1 - s["loss"]),
            thrust_per_speed=a.thrust_per_speed * (1 - s["loss"]),
        )),
        (0.15, 0.3), 0.45, _named("loss"), lambda a, s: {"thrust_lost": s["loss"]},
    ),
    "battery_sag": HiddenEffect(
        _battery_sag, (0.1, 0.2), 0.35, _named("sag"), lambda a, s: {"sag": s["sag"]},
    ),
    "propeller_torque": HiddenEffect(
        _propeller_torque, (0.004, 0.015), 0.03,  # lever of the thrust [m]
        lambda rng, size, a: dict(zip(("arm_roll", "arm_yaw"), _direction(rng, size), strict=True)),
        lambda a, s: {
            "torque_roll": a.mass * s["arm_roll"] / a.Ixx,
            "torque_yaw": a.mass * s["arm_yaw"] / a.Izz,
        },
    ),
    "adverse_yaw": HiddenEffect(
        _adverse_yaw, (0.0025, 0.006), 0.02, _named("ady"),
        lambda a, s: {"adverse_yaw": _yaw_per_inertia(a) * s["ady"]},
    ),
    "control_delay": HiddenEffect(  # on top of the aircraft's own, in whole integration steps
        lambda a, s: Acting(replace(a, delay=a.delay + s["delay"])), (0.015, 0.03), 0.12,
        lambda rng, size, a: {"delay": _whole_steps(size)},
        lambda a, s: {"control_delay": s["delay"]},
    ),
    "actuator_lag": HiddenEffect(  # slower servos, or something slow before them
        _actuator_lag, (0.02, 0.04), 0.15,
        lambda rng, size, a: {"lag": size, "in_series": bool(rng.random() < 0.5)},
        lambda a, s: {"actuator_lag": s["lag"]},
    ),
    "trim_bias": HiddenEffect(
        _trim_bias, (0.06, 0.1), 0.2, lambda rng, size, a: {"bias": _direction(rng, size, 3)},
        lambda a, s: dict(
            zip(("bias_aileron", "bias_elevator", "bias_rudder"), s["bias"], strict=True)
        ),
    ),
    "deadband": HiddenEffect(
        _deadband, (0.03, 0.05), 0.15, _named("band"), lambda a, s: {"deadband": s["band"]},
    ),
    "aileron_loss": HiddenEffect(
        lambda a, s: Acting(replace(a, Clda=a.Clda * (1.0 - s["loss"]))),
        (0.15, 0.2), 0.55, _named("loss"),
        lambda a, s: {"aileron_lost": s["loss"]},
    ),
    "mass_change": HiddenEffect(
        lambda a, s: Acting(replace(a, mass=a.mass * (1.0 + s["mass"]))),
        (0.1, 0.18), 0.35, _named("mass"),
        lambda a, s: {"mass_added": s["mass"]},
    ),
    "cg_shift": HiddenEffect(
        lambda a, s: Acting(replace(a, cg_back=a.cg_back + s["back"])),
        (0.001, 0.003), 0.006, _named("back", True),
        lambda a, s: {"cg_moment": a.mass * s["back"] / a.Iyy},
    ),
    "camera_tilt": HiddenEffect(
        lambda a, s: Acting(a, tilt=tuple(s["tilt"])), (0.014, 0.05), 0.12,
        lambda rng, size, a: {"tilt": _direction(rng, size)},  # up, about the nose [rad]
        lambda a, s: {"tilt_pitch": s["tilt"][0], "tilt_roll": s["tilt"][1]},
    ),
    "time_offset": HiddenEffect(
        lambda a, s: Acting(a, late=s["offset"]), (0.01, 0.03), 0.12, _named("offset"),
        lambda a, s: {"control_delay": s["offset"]},
    ),
    "stall": HiddenEffect(
        _stall, (0.3, 0.5), 0.9,
        lambda rng, size, a: {
            "loss": size, "alpha": (float(rng.uniform(0.75, 0.95)) - a.CL0) / a.CLa,
        },
        lambda a, s: {"stall_alpha": s["alpha"], "stall_loss": s["loss"]},
    ),
    "gust_field": HiddenEffect(
        _gust_field, (0.3, 0.6), 1.0,
        lambda rng, size, a: {
            "gust": size, "wavelength": float(rng.uniform(4.0, 9.0)),
            "phase": float(rng.uniform(0.0, 6.0)),
        },
    ),
    "thrust_line": HiddenEffect(_thrust_line, (0.004, 0.008), 0.015, _named("arm", True)),
    "elevator_play": HiddenEffect(_elevator_play, (0.06, 0.1), 0.25, _named("play")),
}  # fmt: skip
OUTSIDE = ("gust_field", "thrust_line", "elevator_play")  # in no catalogue
IN_CATALOGUE = tuple(name for name in EFFECTS if name not in (*OUTSIDE, "none"))
