"""Sizing: mass, bank and hall -> minimum speed, turn radius and largest mass.

The paper's appendix takes the turn at the minimum speed of level flight. A banked wing must produce
more lift than the weight, so a level turn at maximum lift is faster and wider: `paper_turn_radius`
and `level_turn_radius` are the two answers.

All functions take numbers or arrays and broadcast them: mass in kg, speed in m/s, radius in m, bank
in rad (None: the airframe's bank limit). They raise InputError where a mass, speed or radius is not
positive or a bank is not inside (0, pi/2). `airframe` gives air density rho, wing area S and the
maximum lift coefficient C.
"""

import numpy as np
from numpy.typing import ArrayLike

from falconwing_kit.aircraft.airframe import Airframe
from falconwing_kit.core.checks import Array, InputError, require_range
from falconwing_kit.core.frames import GRAVITY


def minimum_speed(mass: ArrayLike, airframe: Airframe) -> Array:
    """Minimum speed of level flight, wings level, at the maximum lift coefficient.

    1/2 rho V^2 S C = m g   [paper, Appendix]
    """
    weight = _require_positive("mass", mass) * GRAVITY
    return np.sqrt(
        weight / (0.5 * airframe.air_density * airframe.wing_area * airframe.aero.CL_max)
    )


def turn_radius(speed: ArrayLike, bank: ArrayLike) -> Array:
    """Radius of a level, coordinated turn at a speed V.

    R = V^2 / (g tan(phi))   [paper, Appendix]
    """
    return np.asarray(
        _require_positive("speed", speed) ** 2 / (GRAVITY * np.tan(_require_bank(bank)))
    )


def paper_turn_radius(mass: ArrayLike, airframe: Airframe, bank: ArrayLike | None = None) -> Array:
    """Smallest turn radius as in the paper: at the minimum speed of straight flight.

    The wing then lifts only cos(phi) of the weight and the aircraft sinks; see `level_turn_radius`.
    """
    return turn_radius(minimum_speed(mass, airframe), airframe.bank_limit if bank is None else bank)


def load_factor(bank: ArrayLike) -> Array:
    """Load factor of a level turn: lift over weight.

    n = 1 / cos(phi)   [the vertical part of the lift balances the weight, textbook]
    """
    return np.asarray(1.0 / np.cos(_require_bank(bank)))


def level_turn_speed(mass: ArrayLike, airframe: Airframe, bank: ArrayLike | None = None) -> Array:
    """Minimum speed of a level turn.

    1/2 rho V^2 S C = n m g, so V = V_min sqrt(n)   [textbook]
    """
    return minimum_speed(mass, airframe) * np.sqrt(
        load_factor(airframe.bank_limit if bank is None else bank)
    )


def level_turn_radius(mass: ArrayLike, airframe: Airframe, bank: ArrayLike | None = None) -> Array:
    """Smallest radius of a level turn.

    R = n V_min^2 / (g tan(phi)) = V_min^2 / (g sin(phi))   [textbook]
    """
    bank = airframe.bank_limit if bank is None else bank
    return turn_radius(level_turn_speed(mass, airframe, bank), bank)


def level_turn_bank(mass: ArrayLike, airframe: Airframe, radius: ArrayLike) -> Array:
    """Bank of a level turn of a given radius at maximum lift; nan where no bank is enough.

    sin(phi) = V_min^2 / (g R)   [`level_turn_radius`, solved for phi]
    """
    sine = minimum_speed(mass, airframe) ** 2 / (GRAVITY * _require_positive("radius", radius))
    return np.arcsin(np.where(sine < 1.0, sine, np.nan))


def wing_loading(mass: ArrayLike, airframe: Airframe) -> Array:
    """Weight over wing area [N/m^2]; it determines the minimum speed."""
    return np.asarray(_require_positive("mass", mass) * GRAVITY / airframe.wing_area)


def largest_mass(
    hall_width: ArrayLike,
    airframe: Airframe,
    bank: ArrayLike | None = None,
    *,
    margin: float = 0.0,
    hold_height: bool = False,
) -> Array:
    """Largest mass whose full circle fits across a hall [m]: 2 R + margin <= width.

    m = 1/2 rho S C R tan(phi)   [paper, Appendix, solved for m; gravity cancels]
    m = 1/2 rho S C R sin(phi)   [the same with the load factor, hold_height=True]

    Args:
        hall_width: (...) [m].
        airframe: see above.
        bank: phi (...) [rad].
        margin: free width, both sides together [m]. R is the path of the centre of gravity, so a
            wing tip alone needs span * cos(phi).
        hold_height: False as in the paper, True for a level turn.

    Raises:
        InputError: the margin is negative or leaves no width, or a bank is outside (0, pi/2).
    """
    free = np.asarray(hall_width, np.float64) - require_range("margin", margin, low=0.0)
    radius = _require_positive("hall width less the margin", free) / 2.0
    phi = _require_bank(airframe.bank_limit if bank is None else bank)
    lift_per_speed = 0.5 * airframe.air_density * airframe.wing_area * airframe.aero.CL_max
    return np.asarray(lift_per_speed * radius * (np.sin(phi) if hold_height else np.tan(phi)))


def unlisted_mass(airframe: Airframe) -> float:
    """Mass as flown less the sum of the listed parts [kg].

    Negative where the parts are heavier, as with the paper's 150 g against 137 + 9 + 5 = 151 g.
    """
    return airframe.mass - airframe.parts_mass


def _require_positive(name: str, values: ArrayLike) -> Array:
    """The values as float64; InputError unless all are finite and positive."""
    array = np.asarray(values, np.float64)
    if not np.all(np.isfinite(array) & (array > 0.0)):
        raise InputError(f"{name}: expected positive numbers, got {array}")
    return array


def _require_bank(values: ArrayLike) -> Array:
    """Bank angles as float64; InputError unless all are inside (0, pi/2)."""
    if np.any(_require_positive("bank", values) >= np.pi / 2):
        raise InputError(f"bank: expected angles below 90 deg, got {np.degrees(values)} deg")
    return np.asarray(values, np.float64)
