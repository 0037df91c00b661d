"""Lab 1, rewritten with a wrong idea: of each exercise the idea, its kind, the function's body."""

REWRITTEN = {
    "mass_budget": (
        (
            "weights each kind of part once instead of each piece",
            "form",
            """
    alone = [part for part in parts if part[4] == ""]
    masses = np.array([part[2] for part in alone])
    places = np.array([part[3] for part in alone])
    return float(masses.sum()), float(masses @ places / masses.sum())
""",
        ),
        (
            "the centre is the middle between the first and the last part",
            "form",
            """
    alone = [part for part in parts if not part[4]]
    total = sum(part[1] * part[2] for part in alone)
    places = [part[3] for part in alone]
    return total, 0.5 * (min(places) + max(places))
""",
        ),
        (
            "what is inside counts in the moment",
            "form",
            """
    total = sum(part[1] * part[2] for part in parts if part[4] == "")
    moment = sum(part[1] * part[2] * part[3] for part in parts)
    return total, moment / total
""",
        ),
    ),
    "min_speed": (
        (
            "the pressure drops with the temperature, density is that of the standard day",
            "form",
            """
    mass = np.asarray(mass_g) * 1e-3
    density = 1.225
    v_squared = 2.0 * mass * GRAVITY / density / WING_AREA / LIFT_COEFFICIENT
    return v_squared**0.5
""",
        ),
        (
            "stays in grams and in degrees Celsius",
            "form",
            """
    density = PRESSURE / AIR_GAS_CONSTANT / temperature_c
    force = np.asarray(mass_g) * GRAVITY
    return np.sqrt(force / (0.5 * density * WING_AREA * LIFT_COEFFICIENT))
""",
        ),
        (
            "the speed grows with the density, which stands above the fraction's line",
            "form",
            """
    kelvin = 273.15 + temperature_c
    rho = PRESSURE / kelvin / AIR_GAS_CONSTANT
    kilograms = np.asarray(mass_g) / 1000
    return np.sqrt(2 * kilograms * GRAVITY * rho / (WING_AREA * LIFT_COEFFICIENT))
""",
        ),
    ),
    "level_turn": (
        (
            "the load factor is what pulls inward, the tangent",
            "form",
            """
    phi = bank_deg * np.pi / 180
    n = np.tan(phi)
    v = v_min * COHORT["speed_reserve"] * n**0.5
    return n, v, v * v / GRAVITY / np.tan(phi)
""",
        ),
        (
            "the reserve is left out of the radius",
            "form",
            """
    phi = np.deg2rad(bank_deg)
    n = 1 / np.cos(phi)
    slowest = v_min * np.sqrt(n)
    radius = slowest * slowest / (GRAVITY * np.tan(phi))
    return n, COHORT["speed_reserve"] * slowest, radius
""",
        ),
    ),
    "max_mass_for_room": (
        (
            "the whole corridor is the radius",
            "factor",
            """
    phi = np.deg2rad(bank_deg)
    free = np.asarray(width) - SPAN * np.cos(phi) - 2 * COHORT["wall_clearance"]
    free = np.clip(free, 0, None)
    kilograms = lift_per_speed2 * np.sin(phi) * free / COHORT["speed_reserve"] ** 2
    return kilograms * 1000
""",
        ),
        (
            "the turn needs no reserve, and the wing its whole span",
            "form",
            """
    phi = np.deg2rad(bank_deg)
    radius = np.clip(np.asarray(width) - SPAN - 2 * COHORT["wall_clearance"], 0, None) / 2
    return 1e3 * lift_per_speed2 * radius * np.sin(phi)
""",
        ),
    ),
}
