"""Lab 7, rewritten with a wrong idea: of each exercise the idea, its kind, the function's body."""

REWRITTEN = {
    "turn": (
        (
            "the bank's sine for its tangent: a steady turn as on a wire",
            "form",
            """
    bank = np.arcsin(np.clip(speed * speed * np.cos(climb) / GRAVITY / radius, -1, 1))
    load = np.cos(climb) / np.cos(bank)
    slowest = (load * GRAVITY / (LIFT_0 + LIFT_SLOPE * STALL_ALPHA)) ** 0.5
    return bank, speed / slowest
""",
        ),
        (
            "the margin against the stall speed of straight flight",
            "form",
            """
    bank = np.arctan2(speed**2 * np.cos(climb), GRAVITY * radius)
    most = LIFT_0 + LIFT_SLOPE * STALL_ALPHA
    return bank, speed / np.sqrt(GRAVITY / most)
""",
        ),
    ),
    "turn_rates": (
        (
            "all of the turn is yaw",
            "form",
            """
    rate = GRAVITY / speed * np.tan(bank)
    return 0.0 * rate, 0.0 * rate, rate
""",
        ),
        (
            "pitch and bank are exchanged in the split",
            "form",
            """
    rate = GRAVITY / speed * np.tan(bank)
    turned = np.array([-np.sin(bank), np.sin(pitch) * np.cos(bank), np.cos(pitch) * np.cos(bank)])
    p, q, r = rate * turned
    return p, q, r
""",
        ),
    ),
    "guidance": (
        (
            "aims at the leg's end, not at the line",
            "form",
            """
    to_end = end - p
    wanted = math.atan2(-to_end[1], to_end[0])
    error = wanted - math.atan2(-v[1], v[0])
    error = math.atan2(math.sin(error), math.cos(error))
    bank = math.atan(TURN_GAIN * error * math.hypot(v[0], v[1]) / GRAVITY)
    return max(-bank_limit, min(bank_limit, bank))
""",
        ),
        (
            "the offset is positive to the left",
            "sign",
            """
    leg_length = math.dist(end, start)
    x, y = (end[0] - start[0]) / leg_length, (end[1] - start[1]) / leg_length
    off = -(p[0] - start[0]) * y + (p[1] - start[1]) * x
    wanted = math.atan2(-y, x) - 2 * APPROACH / math.pi * math.atan(off * PULL)
    error = wanted - math.atan2(-v[1], v[0])
    error = math.atan2(math.sin(error), math.cos(error))
    bank = math.atan(TURN_GAIN * error * math.hypot(v[0], v[1]) / GRAVITY)
    return max(-bank_limit, min(bank_limit, bank))
""",
        ),
    ),
    "hold_speed": (
        (
            "the integral is clipped instead of frozen",
            "form",
            """
    integral = min(max(integral + error * STEP, 0.0), 1.0 / KI)
    out = base + KP * error + KI * integral
    return float(np.clip(out, 0, 1)), integral
""",
        ),
        (
            "the integral is frozen whenever the throttle is at a stop",
            "form",
            """
    tried = integral + STEP * error
    out = base + KP * error + KI * tried
    if out > 1 or out < 0:
        tried = integral
    return float(np.clip(base + KP * error + KI * tried, 0, 1)), tried
""",
        ),
    ),
    "flare": (
        (
            "the flare begins at a height, not where the two meet",
            "form",
            """
    if height < 0.5:
        return -(COHORT["touch_sink"] + max(height, 0) / FLARE_TIME), True
    sink = speed * math.sin(GLIDE) - SLOPE_GAIN * (distance * math.tan(GLIDE) - height)
    return -float(np.clip(sink, 0, speed * math.sin(STEEPEST))), False
""",
        ),
        (
            "too low sinks faster",
            "sign",
            """
    above = height - distance * math.tan(GLIDE)
    steep = speed * math.sin(STEEPEST)
    glide = float(np.clip(speed * math.sin(GLIDE) - SLOPE_GAIN * above, 0.0, steep))
    touch = COHORT["touch_sink"] + max(height, 0.0) / FLARE_TIME
    return (-touch, True) if touch < glide else (-glide, False)
""",
        ),
    ),
}
