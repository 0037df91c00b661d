"""Lab 1, public: the exercises, what a right function does, and what a person looks for."""

import math

import numpy as np
from given import COHORT, GRAVITY

from falconwing_kit.tools.grading import Check, Criterion, Exercise, Function, Lab, is_same_answer

RESERVE, CLEARANCE = COHORT["speed_reserve"], COHORT["wall_clearance"]
LONE = ("wing", 1, 100.0, 40.0, "")


def _counts_pieces(mass_budget: Function) -> bool:
    """By hand: 100 + 3 * 10 = 130 g, moments 4000 - 3 * 10 * 25 = 3250 g mm, 3250 / 130 = 25 mm."""
    return is_same_answer(mass_budget([LONE, ("screw", 3, 10.0, -25.0, "")]), (130.0, 25.0))


def _skips_what_is_inside(mass_budget: Function) -> bool:
    """By hand: the motor is weighed with the wing, so only the wing counts."""
    return is_same_answer(mass_budget([LONE, ("motor", 2, 30.0, -90.0, "wing")]), (100.0, 40.0))


def _orders_do_not_matter(mass_budget: Function) -> bool:
    parts = [
        LONE,
        ("tail", 2, 7.0, 300.0, ""),
        ("servo", 1, 4.0, 30.0, "tail"),
        ("nose", 1, 20.0, -100.0, ""),
    ]
    forward, backward = mass_budget(parts), mass_budget(parts[::-1])
    return is_same_answer((forward, backward), ((134.0, 6200.0 / 134.0),) * 2)


def _paper_speed(min_speed: Function) -> bool:
    """By hand: at 20 deg C rho = 1.2041; V^2 = 2 * 0.15 * 9.8 / (1.2041 * 0.076 * 0.6) = 53.545."""
    return is_same_answer(min_speed(150.0, 20.0), 7.3174, rtol=1e-4)


def _four_times_the_mass(min_speed: Function) -> bool:
    """V ~ sqrt(m); an array comes back as an array of its shape."""
    speeds = np.asarray(min_speed(np.array([[40.0, 160.0], [360.0, 640.0]]), 5.0))
    return is_same_answer(speeds / speeds[0, 0], np.array([[1.0, 2.0], [3.0, 4.0]]))


def _warm_air_is_thin(min_speed: Function) -> bool:
    """Gay-Lussac: twice the absolute temperature, half the density, sqrt(2) times the speed."""
    cold, warm = -73.15, 126.85
    return is_same_answer(min_speed(80.0, warm) / min_speed(80.0, cold), math.sqrt(2.0))


def _sixty_degrees(level_turn: Function) -> bool:
    """By hand: cos 60 = 1/2, so n = 2; V = k * 7 * sqrt 2; R = 2 * 49 k^2 / (9.8 tan 60)."""
    radius = 2.0 * 49.0 * RESERVE**2 / (GRAVITY * math.sqrt(3.0))
    return is_same_answer(level_turn(7.0, 60.0), (2.0, 7.0 * RESERVE * math.sqrt(2.0), radius))


def _lift_carries_and_pulls(level_turn: Function) -> bool:
    """Pythagoras: (n g)^2 = g^2 + (V^2 / R)^2, whatever the reserve."""
    n, speed, radius = level_turn(np.array([5.0, 7.0, 9.0]), np.array([20.0, 35.0, 50.0]))
    return is_same_answer((n * GRAVITY) ** 2, GRAVITY**2 + (speed**2 / radius) ** 2)


def _shallow_turn(level_turn: Function) -> bool:
    """Limit: hardly banked, n = 1 and the speed is the reserve times the slowest one."""
    n, speed, _ = level_turn(6.0, 0.01)
    return is_same_answer((n, speed), (1.0, 6.0 * RESERVE), rtol=1e-6)


def _room_by_hand(max_mass: Function) -> bool:
    """By hand: bank 30, A = 0.03 kg/m, and 2 R = 16 m left: m = 0.03 * 8 * 0.5 / k^2 kg."""
    width = 16.0 + 0.7 * math.cos(math.pi / 6.0) + 2.0 * CLEARANCE
    return is_same_answer(max_mass(width, 30.0, 0.03), 120.0 / RESERVE**2)


def _two_rooms_differ_by_their_width(max_mass: Function) -> bool:
    """Mass is linear in the width: each 2 m add sin(bank) A 1000 / k^2."""
    masses = np.asarray(max_mass(np.array([12.0, 14.0, 16.0]), 50.0, 0.02))
    return is_same_answer(
        np.diff(masses), np.full(2, 20.0 * math.sin(math.radians(50.0)) / RESERVE**2)
    )


def _too_narrow(max_mass: Function) -> bool:
    """No mass is negative: a corridor narrower than wing and clearance carries nothing."""
    return is_same_answer(max_mass(np.array([0.3, 0.5]), 30.0, 0.03), np.zeros(2))


LAB = Lab(
    name="lab01",
    title="Sizing",
    hours=2.0,
    exercises=(
        Exercise(
            "mass_budget",
            15.0,
            (
                Check(
                    "pieces are counted, each with its own mass and place",
                    _counts_pieces,
                    "use count * mass_g in both sums; divide the moment by the total mass",
                ),
                Check(
                    "a part that is weighed with another one adds nothing",
                    _skips_what_is_inside,
                    "look at the last entry of each tuple: only parts with an empty one were "
                    "weighed alone",
                ),
                Check(
                    "the order of the list does not matter",
                    _orders_do_not_matter,
                    "start both sums at zero and treat every part in the same way",
                ),
            ),
        ),
        Exercise(
            "min_speed",
            20.0,
            (
                Check(
                    "150 g at 20 deg C need 7.32 m/s",
                    _paper_speed,
                    "check units one by one: grams to kilograms, Celsius to kelvin, "
                    "the factor 1/2 in the lift",
                ),
                Check(
                    "four times the mass flies twice as fast, and an array gives an array",
                    _four_times_the_mass,
                    "the lift grows with the square of the speed; use NumPy's functions, "
                    "not math's",
                ),
                Check(
                    "twice the absolute temperature makes it sqrt(2) times as fast",
                    _warm_air_is_thin,
                    "the ideal gas law takes the temperature in kelvin, 273.15 more than in deg C",
                ),
            ),
        ),
        Exercise(
            "level_turn",
            20.0,
            (
                Check(
                    "at 60 deg the load factor is 2",
                    _sixty_degrees,
                    "degrees to radians first; the turn's slowest speed is v_min sqrt(n), "
                    "the reserve comes on top",
                ),
                Check(
                    "the lift carries the weight and pulls into the turn",
                    _lift_carries_and_pulls,
                    "put the speed that is flown, not v_min, into the radius",
                ),
                Check(
                    "hardly banked, it flies at the reserve times v_min",
                    _shallow_turn,
                    "the reserve multiplies the speed once; n goes to 1 when the bank goes to 0",
                ),
            ),
        ),
        Exercise(
            "max_mass_for_room",
            20.0,
            (
                Check(
                    "a room that leaves 16 m carries 120 g over the reserve squared, "
                    "at 30 deg and 0.03 kg/m",
                    _room_by_hand,
                    "2 R is what wing and clearance leave of the width; a level turn has the sine, "
                    "not the tangent",
                ),
                Check(
                    "each metre of width adds the same mass",
                    _two_rooms_differ_by_their_width,
                    "the mass is proportional to R; the reserve enters squared; grams",
                ),
                Check(
                    "a corridor carries nothing",
                    _too_narrow,
                    "where the width leaves nothing, return 0, for each width of an array",
                ),
            ),
        ),
    ),
    rubric=(
        Criterion(
            "radius",
            8.0,
            "three lines that rise in proportion to mass, the hall's line, labels with units",
        ),
        Criterion(
            "radius_reading",
            7.0,
            "150 g fit on the paper's line and at 60 deg, not in the level turn at 30 deg; "
            "300 g nowhere; the level "
            "turn is wider by the same factor at every mass (1.65 in the open course)",
        ),
        Criterion(
            "q1",
            5.0,
            "150 + 174 = 324 g (10.35 m/s, 18.9 m), 300 g is what 9.96 m/s and 17.5 m belong to; "
            "the "
            "parts sum to 151 g, the receiver is not counted twice",
        ),
        Criterion(
            "q2",
            5.0,
            "two of: load factor (1.155), density (8 %), reserve squared with wing and clearance; "
            "a "
            "change that follows from R ~ m / (C sin(bank))",
        ),
    ),
    constants={"speed_reserve": (1.05, 1.25, 2), "wall_clearance": (0.3, 0.9, 1)},
)
