"""Sizing: a mass, a bank and a hall -> how slow the aircraft can fly, how tight it turns, how heavy
it may be.

The paper's appendix takes the turn at the minimum speed of level flight. A banked wing must lift
more than the weight, so a level turn at full lift is faster and wider; `paper_turn_radius` and
`level_turn_radius` are the two answers. All functions take numbers or arrays and broadcast them.
"""

import numpy as np
from numpy.typing import ArrayLike

from falconwing_kit.aircraft.airframe import Airframe
from falconwing_kit.core.checks import Array, InputError, require_range
from falconwing_kit.core.frames import GRAVITY


def minimum_speed(mass: ArrayLike, airframe: Airframe) -> Array:
    """Slowest level flight, wings level, at the largest lift coefficient.

    L = 1/2 rho V^2 S C >= m g   [paper, Appendix]

    Args:
        mass: (...) [kg], > 0.
        airframe: air density rho, wing area S and largest lift coefficient C.

    Returns:
        V (...) [m/s].

    Raises:
        InputError: a mass is not positive.
    """
    weight = _require_positive("mass", mass) * GRAVITY
    return np.sqrt(
        weight / (0.5 * airframe.air_density * airframe.wing_area * airframe.aero.CL_max)
    )


def turn_radius(speed: ArrayLike, bank: ArrayLike) -> Array:
    """Radius of a level, coordinated turn.

    R = V^2 / (g tan(phi))   [paper, Appendix]

    Args:
        speed: V (...) through the air [m/s], > 0.
        bank: phi (...) [rad], between 0 and pi/2.

    Returns:
        R (...) [m].

    Raises:
        InputError: a speed is not positive or a bank is out of its interval.
    """
    return np.asarray(
        _require_positive("speed", speed) ** 2 / (GRAVITY * np.tan(_require_bank(bank)))
    )


def paper_turn_radius(mass: ArrayLike, airframe: Airframe, bank: ArrayLike | None = None) -> Array:
    """Smallest turn radius as the paper gives it: the minimum speed of straight flight, put into
    the turn.

    Flown so, the wing lifts only cos(phi) of the weight and the aircraft sinks; see
    `level_turn_radius`.

    Args:
        mass: (...) [kg], > 0.
        airframe: as for `minimum_speed`.
        bank: phi (...) [rad]; None takes the airframe's bank limit.

    Returns:
        R (...) [m].

    Raises:
        InputError: a mass is not positive or a bank is out of (0, pi/2).
    """
    return turn_radius(minimum_speed(mass, airframe), airframe.bank_limit if bank is None else bank)


def load_factor(bank: ArrayLike) -> Array:
    """Lift over weight in a level turn.

    n = 1 / cos(phi)   [the vertical part of the lift carries the weight, textbook]

    Args:
        bank: phi (...) [rad], between 0 and pi/2.

    Returns:
        n (...) [-].

    Raises:
        InputError: a bank is out of its interval.
    """
    return np.asarray(1.0 / np.cos(_require_bank(bank)))


def level_turn_speed(mass: ArrayLike, airframe: Airframe, bank: ArrayLike | None = None) -> Array:
    """Slowest speed that holds the height in a turn.

    1/2 rho V^2 S C = n m g, so V = V_min sqrt(n)   [textbook]

    Args:
        mass: (...) [kg], > 0.
        airframe: as for `minimum_speed`.
        bank: phi (...) [rad]; None takes the airframe's bank limit.

    Returns:
        V (...) [m/s].

    Raises:
        InputError: a mass is not positive or a bank is out of (0, pi/2).
    """
    return minimum_speed(mass, airframe) * np.sqrt(
        load_factor(airframe.bank_limit if bank is None else bank)
    )


def level_turn_radius(mass: ArrayLike, airframe: Airframe, bank: ArrayLike | None = None) -> Array:
    """Smallest radius of a turn that holds the height.

    R = n V_min^2 / (g tan(phi)) = V_min^2 / (g sin(phi))   [textbook]

    Args:
        mass: (...) [kg], > 0.
        airframe: as for `minimum_speed`.
        bank: phi (...) [rad]; None takes the airframe's bank limit.

    Returns:
        R (...) [m].

    Raises:
        InputError: a mass is not positive or a bank is out of (0, pi/2).
    """
    bank = airframe.bank_limit if bank is None else bank
    return turn_radius(level_turn_speed(mass, airframe, bank), bank)


def level_turn_bank(mass: ArrayLike, airframe: Airframe, radius: ArrayLike) -> Array:
    """Bank that a turn of given radius needs at full lift, height held.

    sin(phi) = V_min^2 / (g R)   [`level_turn_radius`, solved for phi]

    Args:
        mass: (...) [kg], > 0.
        airframe: as for `minimum_speed`.
        radius: R (...) [m], > 0.

    Returns:
        phi (...) [rad]; nan where no bank is enough.

    Raises:
        InputError: a mass or a radius is not positive.
    """
    sine = minimum_speed(mass, airframe) ** 2 / (GRAVITY * _require_positive("radius", radius))
    return np.arcsin(np.where(sine < 1.0, sine, np.nan))


def wing_loading(mass: ArrayLike, airframe: Airframe) -> Array:
    """Weight over wing area, the one number that sets the minimum speed.

    Args:
        mass: (...) [kg], > 0.
        airframe: wing area.

    Returns:
        (...) [N/m^2].

    Raises:
        InputError: a mass is not positive.
    """
    return np.asarray(_require_positive("mass", mass) * GRAVITY / airframe.wing_area)


def largest_mass(
    hall_width: ArrayLike,
    airframe: Airframe,
    bank: ArrayLike | None = None,
    *,
    margin: float = 0.0,
    hold_height: bool = False,
) -> Array:
    """Heaviest aircraft whose full circle fits across the hall: 2 R + margin <= width.

    m = 1/2 rho S C R tan(phi)   [paper, Appendix, solved for m; gravity cancels]
    m = 1/2 rho S C R sin(phi)   [the same with the load factor, hold_height=True]

    Args:
        hall_width: (...) [m].
        airframe: air density, wing area, largest lift coefficient.
        bank: phi (...) [rad]; None takes the airframe's bank limit.
        margin: part of the width the circle must leave free, both sides together [m], >= 0. R is
            the path of the centre of gravity, so a wing tip alone needs span * cos(phi).
        hold_height: False as in the paper, True for a turn that holds its height.

    Returns:
        m (...) [kg].

    Raises:
        InputError: the margin is negative or leaves nothing of the width, or a bank is out of (0,
            pi/2).
    """
    free = np.asarray(hall_width, np.float64) - require_range("margin", margin, low=0.0)
    radius = _require_positive("hall width less the margin", free) / 2.0
    phi = _require_bank(airframe.bank_limit if bank is None else bank)
    lift_per_speed = 0.5 * airframe.air_density * airframe.wing_area * airframe.aero.CL_max
    return np.asarray(lift_per_speed * radius * (np.sin(phi) if hold_height else np.tan(phi)))


def unlisted_mass(airframe: Airframe) -> float:
    """What the list of parts does not explain: the mass as flown less the sum of the parts.

    Args:
        airframe: mass and parts.

    Returns:
        [kg]; negative where the parts weigh more than the whole, as with the paper's 150 g against
        137 + 9 + 5 = 151 g.
    """
    return airframe.mass - airframe.parts_mass


def _require_positive(name: str, values: ArrayLike) -> Array:
    """The values as float64, refused unless all are finite and above zero."""
    array = np.asarray(values, np.float64)
    if not np.all(np.isfinite(array) & (array > 0.0)):
        raise InputError(f"{name}: expected positive numbers, got {array}")
    return array


def _require_bank(values: ArrayLike) -> Array:
    """Bank angles, refused unless all are inside (0, pi/2)."""
    if np.any(_require_positive("bank", values) >= np.pi / 2):
        raise InputError(f"bank: expected angles below 90 deg, got {np.degrees(values)} deg")
    return np.asarray(values, np.float64)
