"""An aircraft that is not the kit's: coefficients and commands -> a flight in JSBSim, with the
interface of the kit's own simulated aircraft.

JSBSim, which is installed apart (`pip install jsbsim`, LGPL), has six degrees of freedom with
linear aerodynamics and servos here. It shares no code with the kit: other equations (quaternions, a
round Earth, wind axes), other frames and units (north-east-down, feet, pounds), another integration
(multistep). The Earth is made not to turn and to pull with the kit's 9.8 m/s^2. What still differs
from the kit's model: the side force lies along the wind axes' y, the usual choice, where the kit
has the right wing; air density falls by 1e-4 per metre of height; pure numbers at low airspeed.

Every coefficient is the property `falcon/<name>` and can be changed in flight, as can JSBSim's own
(`atmosphere/wind-north-fps`). That is the place to hide effects.
"""

import tempfile
from collections.abc import Callable
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from falconwing_kit.aircraft.model import Model, rates_model
from falconwing_kit.core.checks import Array
from falconwing_kit.core.frames import GRAVITY, wrap_angle

FOOT, POUND, EARTH_RADIUS, SEA_LEVEL_DENSITY = (
    0.3048,
    4.4482216152605,
    6_378_137.0,
    1.225,
)  # m, N, m, kg/m^3
STICKS = ("throttle", "aileron", "elevator", "rudder")
STEP = 0.005  # between integration steps [s]
BeforeStep = Callable[[float, Any], None]  # t, JSBSim's FGFDMExec; called before each step


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


class JsbsimFlight:
    """A JSBSim aircraft flown step by step, as `flight.world.FlyingAircraft` describes it.

    The first command also acts before its time; the servos have settled there.
    """

    def __init__(
        self, aircraft: JsbsimAircraft, start: Array, delay: float,
        before_step: BeforeStep | None = None,
    ) -> None:  # fmt: skip
        """Begin at t = 0.

        Args:
            aircraft: what flies.
            start: (12,) in the order of STATE_NAMES, SI.
            delay: of the link, added to the aircraft's own [s]; rounded to whole steps.
            before_step: called before every step with the time and JSBSim; may set any property.
        """
        self.t, self.x = 0.0, np.asarray(start, np.float64).copy()
        self._aircraft, self._start, self._before_step = aircraft, self.x, before_step
        self._delay = delay + aircraft.delay
        self._fdm: Any = None
        self._sent: list[tuple[int, Array]] = []  # step at which a command acts, command
        self._steps = 0

    def send(self, t: float, commands: Array) -> None:
        """Send commands (4,) at a time [s] not before the last."""
        self._sent.append((round((t + self._delay) / STEP), np.asarray(commands, np.float64)))

    def advance(self, t: float) -> None:
        """Fly until t [s], in whole steps of JSBSim."""
        while self._steps < round(t / STEP):
            self._step()
        self.t = max(self.t, t)

    def _step(self) -> None:
        first = self._sent[0][1] if self._sent else np.zeros(4)
        if self._fdm is None:
            self._fdm = new_fdm(self._aircraft, self._start, first)
        arrived = [command for step, command in self._sent if step <= self._steps]
        _set(self._fdm, "falcon/{}-stick", STICKS, arrived[-1] if arrived else first)
        if self._before_step is not None:
            self._before_step(self._steps * STEP, self._fdm)
        self._fdm.run()
        self._steps += 1
        self.x = kit_state(self._fdm)
        self.x[4] = wrap_angle(self.x[4])  # JSBSim's heading is 0 to 360 deg


def set_wind(fdm: Any, v_world: Array) -> None:
    """Set the wind (3,) [m/s] in the kit's world axes: where the air moves to."""
    x, y, z = v_world
    _set(fdm, "atmosphere/wind-{}-fps", ("north", "east", "down"), np.array([x, -y, -z]) / FOOT)


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
