"""aircraft: airframe and sizing, the model f_K as a sum of terms, its integration, trim and
touchdown.
"""

from falconwing_kit.aircraft.airframe import (
    WHEEL_NAMES,
    Aero,
    Airframe,
    AirframePart,
    Inertia,
    Wheels,
    default_airframe_path,
    load_airframe,
    scaling_sentence,
)
from falconwing_kit.aircraft.effect import Effect
from falconwing_kit.aircraft.effects import CATALOGUE, EFFECT_NAMES
from falconwing_kit.aircraft.inputs import actuator_response
from falconwing_kit.aircraft.integrate import ROLL_OUTS, fly, roll_out, step_batch
from falconwing_kit.aircraft.model import (
    FORMS,
    Model,
    add_uniform_wind,
    paper_model,
    rates_model,
    scale_model,
    scale_model_to_speed,
    state_rates,
)
from falconwing_kit.aircraft.sizing import (
    largest_mass,
    level_turn_bank,
    level_turn_radius,
    level_turn_speed,
    load_factor,
    minimum_speed,
    paper_turn_radius,
    turn_radius,
    unlisted_mass,
    wing_loading,
)
from falconwing_kit.aircraft.terms import Flow, Parameter, Term, WindTerm, air_flow
from falconwing_kit.aircraft.touchdown import (
    LandingPad,
    Touchdown,
    find_touchdown,
    pad_height,
    wheel_heights,
    wheel_positions,
    wheel_velocities,
)
from falconwing_kit.aircraft.trim import Mode, Trim, discrete_step, linearise, modes, to_nlsys, trim
from falconwing_kit.aircraft.user_file import load_effects, load_terms, require_effects

__all__ = [
    "CATALOGUE",
    "EFFECT_NAMES",
    "FORMS",
    "ROLL_OUTS",
    "WHEEL_NAMES",
    "Aero",
    "Airframe",
    "AirframePart",
    "Effect",
    "Flow",
    "Inertia",
    "LandingPad",
    "Mode",
    "Model",
    "Parameter",
    "Term",
    "Touchdown",
    "Trim",
    "Wheels",
    "WindTerm",
    "actuator_response",
    "add_uniform_wind",
    "air_flow",
    "default_airframe_path",
    "discrete_step",
    "find_touchdown",
    "fly",
    "largest_mass",
    "level_turn_bank",
    "level_turn_radius",
    "level_turn_speed",
    "linearise",
    "load_airframe",
    "load_effects",
    "load_factor",
    "load_terms",
    "minimum_speed",
    "modes",
    "pad_height",
    "paper_model",
    "paper_turn_radius",
    "rates_model",
    "require_effects",
    "roll_out",
    "scale_model",
    "scale_model_to_speed",
    "scaling_sentence",
    "state_rates",
    "step_batch",
    "to_nlsys",
    "trim",
    "turn_radius",
    "unlisted_mass",
    "wheel_heights",
    "wheel_positions",
    "wheel_velocities",
    "wing_loading",
]
