"""Wrong solutions of lab 7: what is wrong, the replaced text, the replacement."""

MUTANTS = {
    "turn": (
        ("the climb is forgotten in the bank", "speed**2 * np.cos(climb) /", "speed**2 /"),
        (
            "cos(climb) squared, as in the kit",
            "speed**2 * np.cos(climb) /",
            "(speed * np.cos(climb)) ** 2 /",
        ),
        ("the climb is forgotten in n", "np.cos(climb) / np.cos(bank)", "1.0 / np.cos(bank)"),
        ("always to the right", "(GRAVITY * radius)", "(GRAVITY * np.abs(radius))"),
        ("the margin upside down", "speed / stall_speed", "stall_speed / speed"),
        ("sine instead of tangent", "np.arctan(", "np.arcsin(0.2 * "),
        ("the margin of straight flight", "np.sqrt(n * GRAVITY", "np.sqrt(GRAVITY"),
        ("degrees", "return bank,", "return np.degrees(bank),"),
        ("squared speeds", "speed / stall_speed", "(speed / stall_speed) ** 2"),
    ),
    "turn_rates": (
        ("the sign of p", "p = -yaw_rate", "p = yaw_rate"),
        (
            "q and r exchanged",
            "np.sin(bank) * np.cos(pitch)\n    r = yaw_rate * np.cos(bank)",
            "np.cos(bank) * np.cos(pitch)\n    r = yaw_rate * np.sin(bank)",
        ),
        (
            "the pitch is forgotten in q",
            "yaw_rate * np.sin(bank) * np.cos(pitch)",
            "yaw_rate * np.sin(bank)",
        ),
        ("sine of the bank in the turn rate", "GRAVITY * np.tan(bank)", "GRAVITY * np.sin(bank)"),
        (
            "up elevator on the right side only",
            "q = yaw_rate * np.sin(bank)",
            "q = np.abs(yaw_rate) * np.sin(bank)",
        ),
        ("the speed squared", "/ speed", "/ speed**2"),
    ),
    "guidance": (
        (
            "left and right exchanged",
            "np.array([along[1], -along[0]])",
            "np.array([-along[1], along[0]])",
        ),
        (
            "y taken for right in the line's course",
            "math.atan2(-along[1], along[0])",
            "math.atan2(along[1], along[0])",
        ),
        (
            "y taken for right in the flown course",
            "math.atan2(-v[1], v[0])",
            "math.atan2(v[1], v[0])",
        ),
        ("away from the line", "- APPROACH * 2.0", "+ APPROACH * 2.0"),
        ("the long way round", "(error + math.pi) % (2.0 * math.pi) - math.pi", "1.0 * error"),
        ("no limit", "return min(max(bank, -bank_limit), bank_limit)", "return bank"),
        (
            "limited to the right only",
            "min(max(bank, -bank_limit), bank_limit)",
            "min(bank, bank_limit)",
        ),
        ("the line through the origin", "(p - start) @", "p @"),
        (
            "the direction is no unit vector",
            "(end - start) / np.linalg.norm(end - start)",
            "(end - start)",
        ),
        ("the arc tangent is not scaled", "APPROACH * 2.0 / math.pi *", "APPROACH *"),
        (
            "flown course minus commanded",
            "commanded - math.atan2(-v[1], v[0])",
            "math.atan2(-v[1], v[0]) - commanded",
        ),
        ("the speed is forgotten", "np.linalg.norm(v) * TURN_GAIN", "7.0 * TURN_GAIN"),
    ),
    "hold_speed": (
        (
            "winds up",
            "(throttle > 1.0 and error > 0.0) or (throttle < 0.0 and error < 0.0)",
            "False",
        ),
        (
            "stands still at every limit",
            "(throttle > 1.0 and error > 0.0) or (throttle < 0.0 and error < 0.0)",
            "throttle > 1.0 or throttle < 0.0",
        ),
        ("the upper limit only", " or (throttle < 0.0 and error < 0.0)", ""),
        ("the old sum is used", "KI * new\n    if", "KI * integral\n    if"),
        ("the step is forgotten", "integral + error * STEP", "integral + error"),
        ("no limit", "return min(max(throttle, 0.0), 1.0), new", "return throttle, new"),
        ("the throttle down to -1", "max(throttle, 0.0)", "max(throttle, -1.0)"),
        ("the sum starts anew", "        new = integral\n", "        new = 0.0\n"),
        ("the sign of the error", "new = integral + error", "new = integral - error"),
    ),
    "flare": (
        ("never flares", "if soft < approach", "if False"),
        ("the steeper one", "if soft < approach", "if soft > approach"),
        ("sinks upward", "return -soft, True", "return soft, True"),
        ("the motor stays on", "return -soft, True", "return -soft, False"),
        (
            "too low is too high",
            "approach = speed * math.sin(GLIDE) - SLOPE_GAIN",
            "approach = speed * math.sin(GLIDE) + SLOPE_GAIN",
        ),
        ("climbs back to the slope", "min(max(approach, 0.0), speed", "min(approach, speed"),
        (
            "no steepest slope",
            "min(max(approach, 0.0), speed * math.sin(STEEPEST))",
            "max(approach, 0.0)",
        ),
        ("the touchdown's sink rate is forgotten", 'COHORT["touch_sink"] + max', "max"),
        ("negative heights", "max(height, 0.0) / FLARE_TIME", "height / FLARE_TIME"),
        ("times instead of by", "/ FLARE_TIME", "* FLARE_TIME"),
        (
            "the slope's sine",
            "distance * math.tan(GLIDE) - height",
            "distance * math.sin(GLIDE) - height",
        ),
    ),
}
