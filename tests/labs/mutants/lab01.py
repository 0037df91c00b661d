"""Wrong solutions of lab 1: what is wrong, the replaced text, the replacement."""

MUTANTS = {
    "mass_budget": (
        ("counts what is inside again", 'if inside == "":', "if True:"),
        ("forgets how many pieces there are", "total += count * mass_g", "total += mass_g"),
        ("one moment for all pieces", "moment += count * mass_g * x_mm", "moment += mass_g * x_mm"),
        (
            "averages places without weighing them",
            "moment += count * mass_g * x_mm",
            "moment += x_mm",
        ),
        ("leaves the moment undivided", "return total, moment / total", "return total, moment"),
        ("counts only what is inside", 'if inside == "":', 'if inside != "":'),
    ),
    "min_speed": (
        ("grams for kilograms", "/ 1000.0", ""),
        ("celsius for kelvin", "(temperature_c + 273.15)", "(temperature_c + 0.01)"),
        ("no half in the lift", "np.sqrt(2.0 * weight", "np.sqrt(weight"),
        ("forgets the root", "return np.sqrt(2.0 * weight", "return (2.0 * weight"),
        (
            "the paper's density at any temperature",
            "PRESSURE / (AIR_GAS_CONSTANT * (temperature_c + 273.15))",
            "1.3",
        ),
        ("mass for weight", " * GRAVITY", ""),
        (
            "takes the root of the weight only",
            "np.sqrt(2.0 * weight / (density",
            "np.sqrt(2.0 * weight) / ((density",
        ),
    ),
    "level_turn": (
        ("degrees for radians", "np.radians(bank_deg)", "bank_deg"),
        ("the paper's turn, at the speed of straight flight", " * np.sqrt(n)", ""),
        ("load factor for its root", " * np.sqrt(n)", " * n"),
        ("no reserve", 'COHORT["speed_reserve"] * ', ""),
        ("reserve squared", 'COHORT["speed_reserve"] * ', 'COHORT["speed_reserve"]**2 * '),
        ("a reserve of its own", 'COHORT["speed_reserve"]', "1.1"),
        ("sine for tangent", "np.tan(bank)", "np.sin(bank)"),
        ("radius at the slowest speed", "speed**2 / (GRAVITY", "v_min**2 / (GRAVITY"),
        ("speed not squared", "speed**2", "speed"),
    ),
    "max_mass_for_room": (
        ("the paper's turn, which sinks", "np.sin(bank)", "np.tan(bank)"),
        ("diameter for radius", " / 2.0\n    mass", "\n    mass"),
        ("kilograms for grams", "return 1000.0 * mass", "return mass"),
        (
            "clearance on one side only",
            '2.0 * COHORT["wall_clearance"]',
            'COHORT["wall_clearance"]',
        ),
        ("whole span, as if not banked", "SPAN * np.cos(bank)", "SPAN"),
        ("half of the wing", "SPAN * np.cos(bank)", "0.5 * SPAN * np.cos(bank)"),
        ("reserve not squared", 'COHORT["speed_reserve"] ** 2', 'COHORT["speed_reserve"]'),
        (
            "reserve the wrong way",
            '/ COHORT["speed_reserve"] ** 2',
            '* COHORT["speed_reserve"] ** 2',
        ),
        (
            "negative masses in a corridor",
            "np.maximum(np.asarray(width) - taken, 0.0)",
            "(np.asarray(width) - taken)",
        ),
        ("weight instead of mass", "return 1000.0 * mass", "return 9800.0 * mass"),
    ),
}
