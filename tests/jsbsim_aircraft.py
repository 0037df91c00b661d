"""An aircraft that is not ours: JSBSim's six degrees of freedom with linear aerodynamics and
servos. For tests only.

JSBSim shares no code with the kit: other equations (quaternions, a round Earth, wind axes), other
frames and units (north-east-down, feet, pounds), another integration (multistep). The Earth is made
not to turn and to pull with the kit's 9.8 m/s^2. What still differs from the kit's model: the side
force lies along the wind axes' y, the usual choice, where the kit has the right wing; air density
falls by 1e-4 per metre of height; pure numbers at low airspeed.

Every coefficient is the property `falcon/<name>` and can be changed in flight by `before_step`, as
can JSBSim's own (`atmosphere/wind-north-fps`). That is the place to hide effects.
"""

import tempfile
from collections.abc import Callable
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from falconwing_kit.aircraft.model import Model, rates_model
from falconwing_kit.core.frames import GRAVITY

Array = np.ndarray
Pilot = Callable[[float, Array], Array]  # t, state (12,) -> sticks (4,)
BeforeStep = Callable[
    [float, Any], None
]  # t, JSBSim's FGFDMExec; called before each integration step

FOOT, POUND, EARTH_RADIUS, SEA_LEVEL_DENSITY = (
    0.3048,
    4.4482216152605,
    6_378_137.0,
    1.225,
)  # m, N, m, kg/m^3
STICKS = ("throttle", "aileron", "elevator", "rudder")
ROW, STEP = 0.05, 0.005  # s between rows of a flight, and between integration steps
RADIUS, HEIGHT, SPEED = 4.5, 2.2, 7.0  # what the pilot holds: of the two circles [m], [m], [m/s]


@dataclass(frozen=True)
class JsbsimAircraft:
    """Sizes [kg, m, kg m^2] and coefficients on wing area, span and chord; a full stick is 1. 150 g
    by default.
    """

    mass: float = 0.15
    wing_area: float = 0.076
    span: float = 0.70
    chord: float = 0.109
    Ixx: float = 0.00115
    Iyy: float = 0.00146
    Izz: float = 0.00212
    CL0: float = 0.25
    CLa: float = 4.5
    CLde: float = 0.2
    CD0: float = 0.05
    k: float = 0.07  # drag per lift coefficient squared
    CDb: float = 0.6  # drag per sideslip squared
    CYb: float = -0.4
    CYdr: float = 0.1
    Cl0: float = 0.0005
    Clda: float = 0.09
    Clb: float = -0.06
    Clp: float = -0.40
    Clr: float = 0.10
    Cm0: float = 0.06
    Cmde: float = 0.35
    Cma: float = -0.7
    Cmq: float = -9.0
    Cn0: float = -0.0003
    Cndr: float = 0.035
    Cnb: float = 0.07
    Cnr: float = -0.10
    Cnp: float = -0.03
    thrust: float = 1.35  # full throttle, standing [N]
    thrust_per_speed: float = 0.075  # of it lost with speed [N s/m]
    servo: float = 30.0  # bandwidth of all four [rad/s]
    delay: float = 0.02  # from stick to servo [s], a whole number of integration steps
    cg_back: float = 0.0  # centre of gravity behind the point where the aerodynamic forces act [m]

    def redrawn(self, rng: np.random.Generator, spread: float) -> "JsbsimAircraft":
        """The same aircraft, each inertia and coefficient times exp(spread * normal); its sizes and
        delay stay.
        """
        kept = ("mass", "wing_area", "span", "chord", "delay", "cg_back")
        drawn = {
            k: float(v * np.exp(spread * rng.normal()))
            for k, v in asdict(self).items()
            if k not in kept
        }
        drawn["Izz"] = min(
            drawn["Izz"], 0.97 * (drawn["Ixx"] + drawn["Iyy"])
        )  # as of any solid body
        return replace(self, **drawn)

    def kit_model(self, step: float = STEP) -> Model:
        """The kit's 12-state model of the same aircraft: its coefficients per unit mass and
        inertia.

        For a `cg_back` of zero. Exact but for two things. A side force along the wind axes' y leans
        forward by the sideslip: to second order it takes CYb off the sideslip drag. And JSBSim
        answers half an integration step late: a stick acts on the accelerations of the next step,
        of which its servo filter (Tustin) takes half back.
        """
        force = 0.5 * SEA_LEVEL_DENSITY * self.wing_area / self.mass
        roll, yaw = (
            0.5 * SEA_LEVEL_DENSITY * self.wing_area * self.span / inertia
            for inertia in (self.Ixx, self.Izz)
        )
        pitch = 0.5 * SEA_LEVEL_DENSITY * self.wing_area * self.chord / self.Iyy
        half_span, half_chord = 0.5 * self.span, 0.5 * self.chord
        return rates_model().with_values({
            "cL_0": force * self.CL0, "cL_alpha": force * self.CLa, "cL_de": force * self.CLde,
            "cD_0": force * self.CD0, "cD_induced": self.k / force,
            "cD_beta": force * (self.CDb + self.CYb),
            "cY_beta": force * self.CYb, "cY_dr": force * self.CYdr,
            "kT": self.thrust / self.mass, "kTV": self.thrust_per_speed / self.mass,
            "L_0": roll * self.Cl0, "L_da": roll * self.Clda, "L_beta": roll * self.Clb,
            "L_p": roll * half_span * self.Clp, "L_r": roll * half_span * self.Clr,
            "M_0": pitch * self.Cm0, "M_de": pitch * self.Cmde, "M_alpha": pitch * self.Cma,
            "M_q": pitch * half_chord * self.Cmq,
            "N_0": yaw * self.Cn0, "N_dr": yaw * self.Cndr, "N_beta": yaw * self.Cnb,
            "N_r": yaw * half_span * self.Cnr, "N_p": yaw * half_span * self.Cnp,
            "Jx": (self.Iyy - self.Izz) / self.Ixx, "Jy": (self.Izz - self.Ixx) / self.Iyy,
            "Jz": (self.Ixx - self.Iyy) / self.Izz,
            "delay": self.delay + 0.5 * step, "lag": 1.0 / self.servo,
        })  # fmt: skip


def fly_jsbsim(
    aircraft: JsbsimAircraft, pilot: Pilot, seconds: float, start: Array | None = None,
    step: float = STEP, before_step: BeforeStep | None = None,
) -> tuple[Array, Array, Array]:  # fmt: skip
    """Fly with a pilot who sees the true state and moves the sticks 20 times a second.

    Args:
        aircraft: what flies.
        pilot: (t, state) -> sticks; `playback` and `figure_eights` make two.
        seconds: length of the flight.
        start: (12,) start state in the kit's frames, servos settled at the first sticks; None:
            level at speed.
        step: JSBSim's integration step [s], a whole fraction of 50 ms.
        before_step: called before every step with the time and JSBSim; may set any property.

    Returns:
        t (N,) [s], states (N, 12) in the order of STATE_NAMES (yaw unwrapped), sticks (N, 4).
    """
    rows, per_row = round(seconds / ROW) + 1, round(ROW / step)
    begin = (
        np.array([0.0, 0.0, HEIGHT, 0.1, 0.0, 0.0, SPEED, *[0.0] * 5]) if start is None else start
    )
    t, states, sticks = np.arange(rows) * ROW, np.empty((rows, 12)), np.empty((rows, 4))
    states[0], sticks[0] = begin, pilot(0.0, begin)
    fdm = new_fdm(aircraft, begin, sticks[0], step)
    on_their_way = [sticks[0]] * round(aircraft.delay / step)  # one a step
    for k in range(1, rows):
        for j in range(per_row):
            on_their_way.append(sticks[k - 1])
            _set(fdm, "falcon/{}-stick", STICKS, on_their_way.pop(0))
            if before_step is not None:
                before_step(t[k - 1] + j * step, fdm)
            fdm.run()
        states[k] = kit_state(fdm)
        sticks[k] = pilot(t[k], states[k])
    states[:, 4] = np.unwrap(states[:, 4])
    return t, states, sticks


def playback(sticks: Array) -> Pilot:
    """A pilot who repeats sticks (N, 4), a row each 50 ms."""
    return lambda t, state: sticks[min(round(t / ROW), len(sticks) - 1)]


def figure_eights(rng: np.random.Generator, shake: float = 1.0, one_way: bool = False) -> Pilot:
    """A pilot who flies figure eights in a hall of 40 x 20 m and shakes all sticks. A new one for
    each flight.

    Args:
        rng: draws frequencies (0.15 to 1.6 Hz) and phases of the shaking.
        shake: 1 excites every parameter within a minute or two, 0 not at all.
        one_way: circle to the left only.
    """
    frequency, phase = (
        2.0 * np.pi * rng.uniform(0.15, 1.6, (6, 4)),
        rng.uniform(0.0, 2.0 * np.pi, (6, 4)),
    )
    amplitude = shake * np.array([0.035, 0.07, 0.06, 0.08])
    side, far = (
        1.0,
        False,
    )  # left around the circle at +x, right around the one at -x; they touch at the origin
    trim = 0.2  # of the elevator, found on the way, so that any drawn aircraft holds its height

    def pilot(t: float, state: Array) -> Array:
        nonlocal side, far, trim
        px, py, height, pitch, _, roll, vx, vy, vz = state[:9]
        far = far or side * px > RADIUS + 1.0
        if far and side * px < 2.5 and not one_way:
            side, far = -side, False
        from_x, from_y = px - RADIUS * side, py
        outside = np.clip(0.25 * (np.hypot(from_x, from_y) - RADIUS), -1.2, 1.2)
        course = np.arctan2(from_y, from_x) + side * (np.pi / 2 + outside)
        to_the_right = (np.arctan2(vy, vx) - course + np.pi) % (2.0 * np.pi) - np.pi
        bank = np.clip(-0.75 * side + 1.2 * to_the_right, -0.9, 0.9)
        climb = np.clip(0.9 * (HEIGHT - height), -0.8, 0.8)
        trim += 0.1 * ROW * (HEIGHT - height)
        sticks = (
            0.35 + 0.3 * (SPEED - np.sqrt(vx**2 + vy**2 + vz**2)) + 0.15 * climb,
            0.9 * (bank - roll),
            trim + 0.12 + 0.16 * (climb - vz) + 0.43 * bank**2 - pitch,
            0.25 * bank,
        )
        shaken = sticks + amplitude * np.sin(frequency * t + phase).sum(axis=0)
        return np.clip(shaken, [0.0, -1.0, -1.0, -1.0], 1.0)

    return pilot


def new_fdm(aircraft: JsbsimAircraft, start: Array, sticks: Array, step: float = STEP) -> Any:
    """JSBSim with the aircraft in it, at a state (12,) in the kit's frames, its servos settled at
    sticks (4,).
    """
    import jsbsim

    jsbsim.FGJSBBase().debug_lvl = 0
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        (folder / "falcon").mkdir()
        (folder / "falcon" / "falcon.xml").write_text(aircraft_xml(aircraft), encoding="utf-8")
        (folder / "planet.xml").write_text(PLANET_XML, encoding="utf-8")
        fdm = jsbsim.FGFDMExec(name)
        fdm.set_dt(step)
        fdm.load_planet(str(folder / "planet.xml"), False)
        fdm.set_aircraft_path(name)
        fdm.load_model("falcon")
    # Adams-Bashforth of fourth order (5) and, for the attitude, of second (3); the default is Euler
    # in places.
    _set(
        fdm,
        "simulation/integrator/{}",
        ("rate/rotational", "rate/translational", "position/translational"),
        [5] * 3,
    )
    fdm["simulation/integrator/position/rotational"] = 3
    x, y, height, pitch, yaw, roll, vx, vy, vz, *rates = start
    _set(fdm, "ic/{}-rad", ("lat-gc", "long-gc"), (x / EARTH_RADIUS, -y / EARTH_RADIUS))
    _set(fdm, "ic/{}-rad", ("theta", "psi-true", "phi"), (pitch, yaw, roll))
    _set(
        fdm,
        "ic/{}",
        ("h-sl-ft", "vn-fps", "ve-fps", "vd-fps"),
        np.array([height, vx, -vy, -vz]) / FOOT,
    )
    _set(fdm, "ic/{}-rad_sec", "pqr", rates)
    _set(fdm, "falcon/{}-stick", STICKS, sticks)
    fdm["falcon/servo"] = 2.0 / step  # with this bandwidth the filters settle in two rounds
    fdm.run_ic()
    fdm.run_ic()
    fdm["falcon/servo"] = aircraft.servo
    return fdm


def kit_state(fdm: Any) -> Array:
    """The state (12,) in the kit's frames: world x north, y west, z up."""
    angles = [fdm[f"attitude/{name}-rad"] for name in ("theta", "psi", "phi")]
    north, east, down = (
        fdm[f"velocities/v-{name}-fps"] * FOOT for name in ("north", "east", "down")
    )
    x, y = fdm["position/lat-gc-rad"] * EARTH_RADIUS, -fdm["position/long-gc-rad"] * EARTH_RADIUS
    rates = [fdm[f"velocities/{name}-rad_sec"] for name in "pqr"]
    return np.array([x, y, fdm["position/h-sl-ft"] * FOOT, *angles, north, -east, -down, *rates])


def _set(fdm: Any, pattern: str, names: Any, values: Any) -> None:
    for name, value in zip(names, values, strict=True):
        fdm[pattern.format(name)] = float(value)


# The aircraft as JSBSim reads it
# ----------------------------------------------------------------------------------

PLANET_XML = f"""<planet name="still"><semimajor_axis unit="M">{EARTH_RADIUS}</semimajor_axis>
<semiminor_axis unit="M">{EARTH_RADIUS}</semiminor_axis>
<rotation_rate unit="RAD/SEC">0</rotation_rate>
<GM unit="M3/SEC2">{GRAVITY * EARTH_RADIUS**2}</GM><J2>0</J2></planet>"""

ALPHA, BETA, SPAN, CHORD = (
    "aero/alpha-rad",
    "aero/beta-rad",
    "aero/bi2vel",
    "aero/ci2vel",
)  # b / 2V and c / 2V
P, Q, R = (f"velocities/{rate}-rad_sec" for rate in "pqr")
AILERON, ELEVATOR, RUDDER = (f"falcon/{name}" for name in STICKS[1:])
PRESSURE_AREA, CL = ("aero/qbar-psf", "metrics/Sw-sqft"), "falcon/CL"
AXES: dict[
    str, tuple[tuple[str, ...], dict[str, tuple[str, ...]]]
] = {  # axis -> its lever and, per coefficient, what else multiplies
    "LIFT": ((), {"CL0": (), "CLa": (ALPHA,), "CLde": (ELEVATOR,)}),
    "DRAG": ((), {"CD0": (), "k": (CL, CL), "CDb": (BETA, BETA)}),
    "SIDE": ((), {"CYb": (BETA,), "CYdr": (RUDDER,)}),
    "ROLL": (
        ("metrics/bw-ft",),
        {"Cl0": (), "Clda": (AILERON,), "Clb": (BETA,), "Clp": (P, SPAN), "Clr": (R, SPAN)},
    ),
    "PITCH": (
        ("metrics/cbarw-ft",),
        {"Cm0": (), "Cmde": (ELEVATOR,), "Cma": (ALPHA,), "Cmq": (Q, CHORD)},
    ),
    "YAW": (
        ("metrics/bw-ft",),
        {"Cn0": (), "Cndr": (RUDDER,), "Cnb": (BETA,), "Cnr": (R, SPAN), "Cnp": (P, SPAN)},
    ),
}


def product(*factors: str | float) -> str:
    """JSBSim's product of properties and numbers."""
    tags = (
        f"<property>{f}</property>" if isinstance(f, str) else f"<value>{f!r}</value>"
        for f in factors
    )
    return f"<product>{''.join(tags)}</product>"


def aircraft_xml(aircraft: JsbsimAircraft) -> str:
    """Sizes, a property for each coefficient, four servos, thrust as an external force,
    aerodynamics as sums.
    """
    properties = "".join(
        f'<property value="{v!r}">falcon/{k}</property>' for k, v in asdict(aircraft).items()
    )
    servos = "".join(
        f'<lag_filter name="falcon/{name}"><input>falcon/{name}-stick</input>'
        "<c1>falcon/servo</c1></lag_filter>"
        for name in STICKS
    )
    axes = ""
    for axis, (lever, coefficients) in AXES.items():
        axes += f'<axis name="{axis}">'
        for name, factors in coefficients.items():
            load = product(*PRESSURE_AREA, *lever, f"falcon/{name}", *factors)
            axes += f'<function name="falcon/{name}-load">{load}</function>'
        axes += "</axis>"
    origin = "<x>0</x><y>0</y><z>0</z>"
    return f"""<?xml version="1.0"?><fdm_config name="falcon" version="2.0" release="ALPHA">
<metrics><wingarea unit="M2">{aircraft.wing_area}</wingarea>
<wingspan unit="M">{aircraft.span}</wingspan><chord unit="M">{aircraft.chord}</chord>
<location name="AERORP" unit="M">{origin}</location></metrics>
<mass_balance><ixx unit="KG*M2">{aircraft.Ixx}</ixx><iyy unit="KG*M2">{aircraft.Iyy}</iyy>
<izz unit="KG*M2">{aircraft.Izz}</izz><emptywt unit="KG">{aircraft.mass}</emptywt>
<location name="CG" unit="M"><x>{aircraft.cg_back!r}</x><y>0</y><z>0</z></location></mass_balance>
<ground_reactions/>
<flight_control name="servos">{properties}<channel name="servos">{servos}</channel></flight_control>
<external_reactions><force name="thrust" frame="BODY"><function name="falcon/thrust-lbs">
<sum>{product("falcon/throttle", "falcon/thrust", 1.0 / POUND)}
{product("falcon/throttle", "falcon/thrust_per_speed", "velocities/vt-fps", -FOOT / POUND)}
</sum></function><location unit="M">{origin}</location>
<direction><x>1</x><y>0</y><z>0</z></direction></force></external_reactions>
<aerodynamics><function name="{CL}"><sum>
<property>falcon/CL0</property>{product("falcon/CLa", ALPHA)}</sum></function>
{axes}</aerodynamics></fdm_config>"""
