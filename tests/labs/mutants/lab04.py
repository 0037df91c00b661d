"""Wrong solutions of lab 4: for each exercise what is wrong, the right text and the wrong one."""

MUTANTS = {
    "air_data": (
        ("adds the wind", "state[6:9] - wind_world", "state[6:9] + wind_world"),
        ("forgets the wind", "state[6:9] - wind_world", "state[6:9] - 0.0 * wind_world"),
        ("turns the wrong way", "R_world_body.T @", "R_world_body @"),
        (
            "takes the angles in another order",
            "pitch, yaw, roll = state",
            "roll, pitch, yaw = state",
        ),
        ("angle of attack with the other sign", "np.arctan2(w, u)", "np.arctan2(-w, u)"),
        ("sideslip as a tangent", "np.arcsin(v / V)", "np.arctan2(v, u)"),
        ("angles in degrees", "np.arctan2(w, u)", "np.degrees(np.arctan2(w, u))"),
        (
            "airspeed without the vertical part",
            "np.sqrt(u**2 + v**2 + w**2)",
            "np.sqrt(u**2 + v**2)",
        ),
    ),
    "body_force": (
        ("lift without the square of the speed", "lift = V**2 * c", "lift = V * c"),
        ("lift down", "0.0, -np.cos(alpha)])", "0.0, np.cos(alpha)])"),
        ("lift square to the fuselage", "[np.sin(alpha), 0.0, -np.cos(alpha)]", "[0.0, 0.0, -1.0]"),
        ("induced drag not squared", 'K["cD_induced"] * c**2', 'K["cD_induced"] * c'),
        ("drag forward", "drag = -(V**2)", "drag = (V**2)"),
        (
            "no sideslip in the path",
            "np.sin(beta), np.sin(alpha) * np.cos(beta)]",
            "0.0, np.sin(alpha) * np.cos(beta)]",
        ),
        ("side force the other way", 'V**2 * K["cY_beta"]', '-(V**2) * K["cY_beta"]'),
        (
            "the kit's thrust, along the nose",
            "[np.cos(DOWN_THRUST), 0.0, np.sin(DOWN_THRUST)]",
            "[1.0, 0.0, 0.0]",
        ),
        ("up-thrust", "0.0, np.sin(DOWN_THRUST)]", "0.0, -np.sin(DOWN_THRUST)]"),
        ("thrust does not fall with speed", '(K["kT"] - K["kTV"] * V)', '(K["kT"])'),
    ),
    "state_rate": (
        ("gravity up", "force_body - gravity", "force_body + gravity"),
        ("gravity turned with the body", "@ force_body - gravity", "@ (force_body + gravity)"),
        ("force not turned", "rotation_world_body(roll, pitch, yaw) @ force_body", "force_body"),
        (
            "force turned the wrong way",
            "rotation_world_body(roll, pitch, yaw) @",
            "rotation_world_body(roll, pitch, yaw).T @",
        ),
        (
            "rates in the order of the gyro",
            "[pitch_dot, yaw_dot, roll_dot]",
            "[roll_dot, pitch_dot, yaw_dot]",
        ),
        (
            "small angles: rates are angle rates",
            "pitch_dot = q * np.cos(roll) - r * np.sin(roll)",
            "pitch_dot = q",
        ),
        ("yaw rate without the cosine", "across / np.cos(pitch)", "across"),
        ("roll rate without the tangent", "p + across * np.tan(pitch)", "p"),
        (
            "sign of r in the pitch rate",
            "np.cos(roll) - r * np.sin(roll)",
            "np.cos(roll) + r * np.sin(roll)",
        ),
    ),
    "rk4_step": (
        (
            "Euler's step",
            "return x + dt / 6.0 * (k1 + 2.0 * k2 + 2.0 * k3 + k4)",
            "return x + dt * k1",
        ),
        ("weights of the mean", "(k1 + 2.0 * k2 + 2.0 * k3 + k4)", "1.5 * (k1 + k2 + k3 + k4)"),
        ("sticks held", "u_mid = 0.5 * (u_now + u_next)", "u_mid = u_next = u_now"),
        (
            "last slope sees the first input",
            "rate(x + dt * k3, u_next)",
            "rate(x + dt * k3, u_now)",
        ),
        (
            "full step for the second slope",
            "rate(x + 0.5 * dt * k1, u_mid)",
            "rate(x + dt * k1, u_mid)",
        ),
        (
            "third slope from the first",
            "rate(x + 0.5 * dt * k2, u_mid)",
            "rate(x + 0.5 * dt * k1, u_mid)",
        ),
        (
            "changes the state in place",
            "return x + dt / 6.0 * (k1 + 2.0 * k2 + 2.0 * k3 + k4)",
            "x += dt / 6.0 * (k1 + 2.0 * k2 + 2.0 * k3 + k4)\n    return 1.0 * x - 0.0",
        ),
    ),
    "trim": (
        ("one round", "range(60)", "range(1)"),
        ("three rounds", "range(60)", "range(3)"),
        (
            "weight along the path with the other sign",
            "(drag + GRAVITY * np.sin(climb_angle))",
            "(drag - GRAVITY * np.sin(climb_angle))",
        ),
        (
            "all of the weight across the path",
            "GRAVITY * np.cos(climb_angle) - thrust",
            "GRAVITY - thrust",
        ),
        ("no down-thrust", "thrust * np.sin(alpha - DOWN_THRUST)", "thrust * np.sin(alpha)"),
        ("thrust does not help the lift", "- thrust * np.sin(alpha - DOWN_THRUST)", "- 0.0"),
        ("thrust of standing", '(K["kT"] - K["kTV"] * V)', 'K["kT"]'),
        (
            "elevator with the other sign",
            '-(K["M_0"] + K["M_alpha"] * alpha)',
            '(K["M_0"] + K["M_alpha"] * alpha)',
        ),
        ("lift over the speed", "lift / V**2", "lift / V"),
    ),
}
