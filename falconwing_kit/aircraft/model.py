"""Model f_K: named terms and their parameter values -> the time derivative of the state.

f_K stands for dx/dt here; integrated over one time step (0.05 s) it is the paper's f_K, the map
x_t -> x_{t+1} [paper, Section IV-B].

The state, in the order of STATE_NAMES (SI, radians):
    x[0:3]   px py pz         position in world axes
    x[3:6]   pitch yaw roll   attitude
    x[6:9]   vx vy vz         velocity in world axes
    x[9:12]  p q r            body rates (12-state model only)
Poses elsewhere are in the order x y z roll pitch yaw: x[[0, 1, 2, 5, 3, 4]].

Input map: the actuator dynamics from logged commands to control positions, a delay and a
first-order lag (`inputs.py`), to which an effect may add.

Two models share everything but their body rates; files and options name them by `form`:
    "paper"  the 9-state model: body rates follow the commands immediately [paper, Section IV-B]
    "rates"  the 12-state model: body rates have dynamics of their own, as a 150 g aircraft needs
"""

from collections import namedtuple
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field, replace
from functools import cache
from typing import Any, Literal

import numpy as np

from falconwing_kit.aircraft.effect import Effect
from falconwing_kit.aircraft.inputs import INPUT_PARAMETERS, actuator_response, second_order_lag
from falconwing_kit.aircraft.terms import (
    FORCES,
    MOMENTS,
    QUASI_STEADY_RATES,
    UNIFORM_WIND,
    Parameter,
    Term,
    WindTerm,
    air_flow,
    sum_loads,
)
from falconwing_kit.core.checks import Array, InputError, require_range
from falconwing_kit.core.frames import (
    GRAVITY,
    euler_rates_of_angles,
    sine_and_cosine,
    turn_to_body,
    turn_to_world,
)

Form = Literal["paper", "rates"]


@dataclass(frozen=True)
class Model:
    """f_K: terms, parameters and their values. A change returns a new model."""

    form: Form
    terms: tuple[Term, ...]
    winds: tuple[WindTerm, ...] = ()
    parameters: tuple[Parameter, ...] = ()
    values: Mapping[str, float] = field(default_factory=dict)
    effects: tuple[
        Effect, ...
    ] = ()  # every effect added; forces and winds are also among the terms

    @property
    def n_states(self) -> int:
        """9 without body rates, 12 with them."""
        return 9 if self.form == "paper" else 12

    @property
    def names(self) -> tuple[str, ...]:
        """Parameter names, in the order of `vector`."""
        return tuple(p.name for p in self.parameters)

    @property
    def vector(self) -> Array:
        """(P,) the parameter values in the order of `names`."""
        return np.array([self.values[name] for name in self.names])

    @property
    def K(self) -> Any:
        """The parameter values as a record with one field per name, which terms read."""
        return parameter_record(self.names)(*(float(self.values[name]) for name in self.names))

    def with_values(self, values: Mapping[str, float]) -> "Model":
        """The same model with some values changed; InputError for an unknown name."""
        unknown = [name for name in values if name not in self.values]
        if unknown:
            raise InputError(f"parameter {unknown[0]!r}: expected one of {', '.join(self.names)}")
        return replace(self, values={**self.values, **{k: float(v) for k, v in values.items()}})

    def with_vector(self, vector: Array) -> "Model":
        """The same model with all values changed; vector (P,) in the order of `names`."""
        return replace(self, values=dict(zip(self.names, map(float, vector), strict=True)))

    def with_fixed(self, names: Iterable[str]) -> "Model":
        """The same model with some parameters fixed at their present values in every fit."""
        fixed = set(names)
        unknown = fixed.difference(self.values)
        if unknown:
            raise InputError(f"parameter {min(unknown)!r}: expected one of {', '.join(self.names)}")
        parameters = tuple(
            replace(p, low=self.values[p.name], high=self.values[p.name]) if p.name in fixed else p
            for p in self.parameters
        )
        return replace(self, parameters=parameters)

    @property
    def actuator_parameter_names(self) -> tuple[str, ...]:
        """Parameters of the input map and of the effects that change the commands."""
        maps = (e for e in self.effects if e.command_map or e.input_map)
        acting = {p.name for p in (*INPUT_PARAMETERS, *(p for e in maps for p in e.parameters))}
        return tuple(name for name in self.names if name in acting)

    def added_input_map(self, K: Any) -> tuple[float, float, float]:
        """Delay, lag and lag in series that the effects add to the model's own [s]."""
        added = [effect.input_map(K) for effect in self.effects if effect.input_map]
        delay, lag, series = (sum(part) for part in zip((0.0, 0.0, 0.0), *added, strict=True))
        return delay, lag, series

    def actuator_positions(
        self, t: Array, commands: Array, edges: Array, K: Any
    ) -> tuple[Array, Array]:
        """Logged commands -> control positions over each integration step, through all input maps.

        Args:
            t: (N,) time of each command [s].
            commands: (N, 4).
            edges: (..., S + 1) ends of the integration steps [s].
            K: parameter record of this model.

        Returns:
            mean and slope, each (..., S, 4), as `actuator_response`.
        """
        for effect in self.effects:
            if effect.command_map is not None:
                commands = effect.command_map(t, commands, K)
        delay, lag, series = self.added_input_map(K)
        mean, slope = actuator_response(
            t, commands, edges, max(K.delay + delay, 0.0), max(K.lag + lag, 0.0)
        )
        return second_order_lag(mean, slope, np.diff(edges, axis=-1), series)

    def measured_pose(self, pose: Array, K: Any) -> Array:
        """(6, ...) poses in the order x y z roll pitch yaw, through all measurement maps."""
        for effect in self.effects:
            if effect.measurement_map is not None:
                pose = effect.measurement_map(pose, K)
        return pose

    def with_effect(self, effect: Effect) -> "Model":
        """The same model with an effect added, its parameters at their starting values."""
        parts = (effect.term(self.terms), effect.wind_term)
        model = self.with_terms(*(part for part in parts if part is not None))
        new = tuple(p for p in effect.parameters if p.name not in model.values)
        return replace(
            model,
            parameters=model.parameters + new,
            values={**model.values, **{p.name: p.start for p in new}},
            effects=(*model.effects, effect),
        )

    def with_terms(self, *terms: Term | WindTerm) -> "Model":
        """The same model with terms added at their starting values."""
        # Two forms of an effect have one name, and parameters of their own.
        mine: tuple[Term | WindTerm, ...] = (*self.terms, *self.winds)
        present = {(t.name, t.parameters) for t in mine}
        twice = [t.name for t in terms if (t.name, t.parameters) in present]
        if twice:
            raise InputError(f"term {twice[0]!r}: expected a new term, got one of the model")
        known = set(self.names)
        parameters = [p for term in terms for p in term.parameters if p.name not in known]
        return replace(
            self,
            terms=self.terms + tuple(t for t in terms if isinstance(t, Term)),
            winds=self.winds + tuple(t for t in terms if isinstance(t, WindTerm)),
            parameters=self.parameters + tuple(parameters),
            values={**self.values, **{p.name: p.start for p in parameters}},
        )


def paper_model() -> Model:
    """The paper's 9-state model with quasi-steady rates: 16 free parameters, no delay, no lag."""
    model = _assemble_model("paper", FORCES + QUASI_STEADY_RATES)
    zero = ("cL_de", "cY_dr", "cD_beta", "delay", "lag")
    return model.with_values(dict.fromkeys(zero, 0.0)).with_fixed(zero)


def rates_model() -> Model:
    """The 12-state model: 29 parameters, servo lag and delay among them."""
    return _assemble_model("rates", FORCES + MOMENTS)


FORMS: dict[Form, Callable[[], Model]] = {"paper": paper_model, "rates": rates_model}


# The aircraft that a fresh model describes; `terms.py` gives its starting values.
_START_MASS, _START_WING_AREA, _START_SPAN, _START_SPEED = 0.150, 0.076, 0.70, 7.0

_WING = ("cL_0", "cL_alpha", "cL_de", "cD_0", "cD_beta", "cY_beta", "cY_dr")
_QUASI_STEADY = (
    "L_0",
    "L_da",
    "L_beta",
    "M_0",
    "M_de",
    "M_alpha",
    "N_0",
    "N_dr",
    "N_beta",
    "L_dr",
    "N_da",
    "L_phi",
    "M_theta",
)
_DAMPING = ("L_p", "L_r", "M_q", "N_r", "N_p")


def scale_model(model: Model, mass: float, wing_area: float, span: float) -> Model:
    """Starting values and bounds for an aircraft of another size, by dynamic similarity.

    Forces per mass go with wing area / mass, rates with 1 / span, moments with 1 / span^2, thrust
    per mass stays and its loss with speed goes with 1 / speed, speed with sqrt(mass / wing area)
    [Raymer, Aircraft Design, ch. 5: scaling laws of similar aircraft]. A fit starts there. Servo
    lag, delay and the ratios of inertia are those of the 150 g aircraft.

    Args:
        model: a model at the starting values of the 150 g aircraft (0.076 m^2, 0.70 m).
        mass: [kg].
        wing_area: [m^2].
        span: [m].

    Raises:
        InputError: a number is not positive.
    """
    area_per_mass = require_range("wing_area", wing_area, low=1e-4) / require_range(
        "mass", mass, low=1e-4
    )
    return _scale(
        model,
        area_per_mass=area_per_mass * _START_MASS / _START_WING_AREA,
        length=require_range("span", span, low=1e-2) / _START_SPAN,
    )


def scale_model_to_speed(model: Model, airspeed: float) -> Model:
    """Starting values and bounds for an aircraft of which only the usual airspeed V is known.

        wing area / mass ~ (7 / V)^2    lift equals weight at the same lift coefficient
        span             ~ V / 7        0.70 m at 7 m/s

    The first line is Froude's: V^2 / (g length) is the same for similar aircraft. The second is
    not: that would be span ~ V^2, a 9 m aircraft at 25 m/s. Aircraft are more heavily loaded the
    larger they are, and the usual speed over the span is near 10 / s for all of this size: 7 m/s
    and 0.70 m here, 18 m/s and 2.0 m [ALFA's T-28, in `data`], 25 m/s and 2.90 m [Aerosonde;
    Beard & McLain, Small Unmanned Aircraft, appendix E]. Angular accelerations and time constants
    at the usual speed are therefore those of the 150 g aircraft.

    Args:
        model: a model at the starting values of the 150 g aircraft.
        airspeed: V, typical of the flight [m/s], 1 to 100.

    Raises:
        InputError: the speed is out of range.
    """
    speed = require_range("airspeed", airspeed, low=1.0, high=100.0) / _START_SPEED
    return _scale(model, area_per_mass=speed**-2, length=speed)


def _scale(model: Model, *, area_per_mass: float, length: float) -> Model:
    """Values and bounds times their factors; both arguments relative to the 150 g aircraft."""
    factors = dict.fromkeys(_WING, area_per_mass)
    factors |= {"cD_induced": 1.0 / area_per_mass, "kTV": area_per_mass**0.5}
    factors |= dict.fromkeys(_QUASI_STEADY, 1.0 / length if model.form == "paper" else length**-2)
    factors |= dict.fromkeys(_DAMPING, 1.0 / length)

    def resize(p: Parameter) -> Parameter:
        f = factors.get(p.name, 1.0)
        return replace(p, start=p.start * f, low=p.low * f, high=p.high * f)

    values = {name: value * factors.get(name, 1.0) for name, value in model.values.items()}
    return replace(model, parameters=tuple(map(resize, model.parameters)), values=values)


def add_scaled_terms(model: Model, *terms: Term) -> Model:
    """A 12-state model with further terms, at the size of the model's aircraft.

    Terms hold the start values and bounds of the 150 g aircraft. They are scaled as `scale_model`
    scales moments, with 1 / span^2, the span by the start value of L_da.

    Args:
        model: of form "rates"; what it has stays as it is.
        terms: whose parameters are new to it, of moments or without dimension.
    """
    small = rates_model()
    start, usual = (next(p.start for p in m.parameters if p.name == "L_da") for m in (model, small))
    length = abs(usual / start) ** 0.5 if start else 1.0
    scaled = {
        p.name: p
        for p in _scale(small.with_terms(*terms), area_per_mass=1.0, length=length).parameters
    }
    extended = model.with_terms(*terms)
    new = [scaled[name] for name in extended.names if name not in model.names]
    kept = {p.name: p for p in (*new, *model.parameters)}
    parameters = tuple(kept[name] for name in extended.names)
    return replace(extended, parameters=parameters).with_values({p.name: p.start for p in new})


def add_uniform_wind(model: Model, wind_x: float = 0.0, wind_y: float = 0.0) -> Model:
    """The model in a uniform wind; its velocity in world axes [m/s] becomes two parameters."""
    return model.with_terms(UNIFORM_WIND).with_values({"wind_x": wind_x, "wind_y": wind_y})


def _assemble_model(form: Form, terms: tuple[Term, ...]) -> Model:
    parameters = tuple(p for term in terms for p in term.parameters) + INPUT_PARAMETERS
    return Model(form, terms, (), parameters, {p.name: p.start for p in parameters})


@cache
def parameter_record(names: tuple[str, ...]) -> Any:
    """A named tuple class with these fields, one class per set of names."""
    return namedtuple("K", names)


def _identity(function: Any) -> Any:
    return function


@cache
def state_rates(
    form: Form, terms: tuple[Term, ...], winds: tuple[WindTerm, ...], compiler: Any = _identity
) -> Any:
    """Build the function (time, x, command, K) -> dx/dt of a model's terms.

    p' = v, v' = g + R_world_body f, attitude by the body rates, body rates by the moments
    [Beard & McLain, eqs. 3.14-3.17]; the forces f are those of the velocity relative to the air.

    x[i] is a number or an array, in the order of STATE_NAMES, command[i] likewise in that of
    COMMAND_NAMES; dx/dt is a tuple of 9 or 12 of them. `compiler` is applied to every function:
    numba's njit compiles this same source.
    """
    loads_of = _sum_of([compiler(t.evaluate) for t in terms], compiler)
    wind_of = _wind_of([compiler(w.evaluate) for w in winds], compiler)
    sines_of = _sines_of_batch if compiler is _identity else compiler(_sines_of_state)
    to_body, to_world = compiler(turn_to_body), compiler(turn_to_world)
    angle_rates, flow_of = compiler(euler_rates_of_angles), compiler(air_flow)
    second_order, has_wind = form == "rates", bool(winds)
    gravity = GRAVITY

    @compiler
    def rates_of_state(time, x, command, K):  # type: ignore[no-untyped-def]
        pitch, roll = x[3], x[5]
        sine, cosine = sines_of(x)
        # Air-relative velocity, in world axes and then in body axes.
        ax, ay, az = x[6], x[7], x[8]
        if has_wind:
            wind_x, wind_y, wind_z = wind_of(x[0], x[1], x[2], time, K)
            ax, ay, az = ax - wind_x, ay - wind_y, az - wind_z
        u, v, w = to_body(sine, cosine, ax, ay, az)
        if second_order:
            p, q, r = x[9], x[10], x[11]
        else:
            p, q, r = 0.0, 0.0, 0.0
        air = flow_of((u, v, w), (p, q, r), (x[0], x[1], x[2]), time, command, (roll, pitch))
        fx, fy, fz, mx, my, mz = loads_of(air, K)
        # Forces turned back to world axes, and gravity.
        vx_dot, vy_dot, force_up = to_world(sine, cosine, fx, fy, fz)
        vz_dot = force_up - gravity
        if second_order:
            roll_dot, pitch_dot, yaw_dot = angle_rates(sine, cosine, p, q, r)
            return (
                x[6],
                x[7],
                x[8],
                pitch_dot,
                yaw_dot,
                roll_dot,
                vx_dot,
                vy_dot,
                vz_dot,
                mx,
                my,
                mz,
            )
        roll_dot, pitch_dot, yaw_dot = angle_rates(sine, cosine, mx, my, mz)
        return x[6], x[7], x[8], pitch_dot, yaw_dot, roll_dot, vx_dot, vy_dot, vz_dot

    return rates_of_state


def _sines_of_state(x):  # type: ignore[no-untyped-def]
    """Sines and cosines of roll, pitch and yaw."""
    roll, pitch, yaw = sine_and_cosine(x[5]), sine_and_cosine(x[3]), sine_and_cosine(x[4])
    return (roll[0], pitch[0], yaw[0]), (roll[1], pitch[1], yaw[1])


def _sines_of_batch(x: Any) -> Any:
    """The same; the three angles of a batch together, as NumPy's calls cost more than its sums."""
    if not isinstance(x, np.ndarray):
        return _sines_of_state(x)
    (sin_pitch, sin_yaw, sin_roll), (cos_pitch, cos_yaw, cos_roll) = sine_and_cosine(x[3:6])
    return (sin_roll, sin_pitch, sin_yaw), (cos_roll, cos_pitch, cos_yaw)


def _sum_of(functions: list[Any], compiler: Any) -> Any:
    """One function that adds the loads of all; pairwise where it is compiled."""
    if compiler is _identity:
        return lambda air, K: _sum_arrays([evaluate(air, K) for evaluate in functions])
    return compiler(sum_loads(functions))


def _sum_arrays(parts: list[Any]) -> list[Any]:
    """Add loads without the plain zeros: most terms have one or two nonzero loads of six."""
    total: list[Any] = [0.0] * 6
    for part in parts:
        for i, load in enumerate(part):
            if type(load) is not float or load != 0.0:
                total[i] = load if type(total[i]) is float and total[i] == 0.0 else total[i] + load
    return total


def _wind_of(functions: list[Any], compiler: Any) -> Any:
    """One function that adds all parts of the wind; zero where there is none."""
    if not functions:

        @compiler
        def still(px, py, height, time, K):  # type: ignore[no-untyped-def]
            return 0.0, 0.0, 0.0

        return still
    first = functions[0]
    if len(functions) == 1:
        return first
    rest = _wind_of(functions[1:], compiler)

    @compiler
    def total(px, py, height, time, K):  # type: ignore[no-untyped-def]
        a, b = first(px, py, height, time, K), rest(px, py, height, time, K)
        return a[0] + b[0], a[1] + b[1], a[2] + b[2]

    return total
