"""Lab 1, instructors only: what the functions are judged against.

The kit's own sizing, in other units and another way.

The kit has no reserve: to fly k times faster than the slowest turn is to turn with 1 / k^2 of the
lift coefficient.
"""

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np
from given import AIR_GAS_CONSTANT, PRESSURE

from falconwing_kit.aircraft import (
    largest_mass,
    level_turn_radius,
    level_turn_speed,
    load_airframe,
    minimum_speed,
)
from falconwing_kit.tools.grading import Course, Judge, Values

AIRFRAME = load_airframe()


def judges(course: Course) -> Mapping[str, tuple[Judge, ...]]:
    """The judges of each exercise.

    Args:
        course: its speed reserve and clearance.

    Returns:
        By exercise.
    """
    reserve, clearance = course.constants["speed_reserve"], course.constants["wall_clearance"]
    aero = replace(AIRFRAME.aero, CL_max=AIRFRAME.aero.CL_max / reserve**2)
    slower = replace(AIRFRAME, aero=aero)  # stalls where the course's aircraft has its reserve left

    def turn(v_min: Any, bank_deg: Any) -> tuple[Any, Any, Any]:
        mass = 1.0 * (np.asarray(v_min) / minimum_speed(1.0, AIRFRAME)) ** 2
        bank = np.radians(bank_deg)
        radius = level_turn_radius(mass, slower, bank)
        n = np.sqrt(1.0 + np.tan(bank) ** 2)
        return n, level_turn_speed(mass, slower, bank), radius

    def mass(width: Any, bank_deg: float, lift_per_speed2: float) -> Any:
        taken = AIRFRAME.span * np.cos(np.radians(bank_deg)) + 2.0 * clearance
        density = 2.0 * lift_per_speed2 / (AIRFRAME.wing_area * AIRFRAME.aero.CL_max)
        wing = replace(slower, air_density=density)
        fits = np.asarray(width) > taken
        room = np.where(fits, width, taken + 1.0)
        heaviest = largest_mass(room, wing, np.radians(bank_deg), margin=taken, hold_height=True)
        return np.where(fits, 1000.0 * heaviest, 0.0)

    return {
        "mass_budget": (Values(_draw_parts, _budget),),
        "min_speed": (Values(_draw_speed, _speed),),
        "level_turn": (Values(_draw_turn, turn),),
        "max_mass_for_room": (Values(_draw_room, mass),),
    }


def _draw_parts(rng: np.random.Generator) -> tuple[Any, ...]:
    """A wing and more parts, of which some are inside one another.

    No piece stands alone, so counts matter.
    """
    names = ["wing", *(f"part {i}" for i in range(int(rng.integers(4, 9))))]
    inside = ["", *rng.choice(["", *names[1:3]], len(names) - 1)]
    inside[1:5] = ["", names[2], "", "wing"]
    numbers = [
        (int(rng.integers(2, 5)), float(rng.uniform(5.0, 30.0)), float(rng.uniform(-200.0, 400.0)))
        for _ in names
    ]
    return (
        [
            (name, *three, str(within))
            for name, three, within in zip(names, numbers, inside, strict=True)
        ],
    )


def _budget(parts: list[tuple[str, int, float, float, str]]) -> tuple[float, float]:
    alone = [part for part in parts if not part[4]]
    masses = np.array([part[1] * part[2] for part in alone])
    return float(masses.sum()), float(np.average([part[3] for part in alone], weights=masses))


def _draw_speed(rng: np.random.Generator) -> tuple[Any, ...]:
    return rng.uniform(30.0, 900.0, (2, int(rng.integers(1, 5)))), float(rng.uniform(-15.0, 40.0))


def _speed(mass_g: Any, temperature_c: float) -> Any:
    density = PRESSURE / (AIR_GAS_CONSTANT * (temperature_c + 273.15))
    return minimum_speed(np.asarray(mass_g) * 1e-3, replace(AIRFRAME, air_density=density))


def _draw_turn(rng: np.random.Generator) -> tuple[Any, ...]:
    count = int(rng.integers(2, 5))
    return rng.uniform(4.0, 12.0, count), rng.uniform(10.0, 70.0, count)


def _draw_room(rng: np.random.Generator) -> tuple[Any, ...]:
    widths = np.append(rng.uniform(8.0, 40.0, 3), rng.uniform(0.1, 0.6))
    return widths, float(rng.uniform(15.0, 65.0)), float(rng.uniform(0.01, 0.05))
