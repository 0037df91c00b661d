"""Lab 4, rewritten with a wrong idea: of each exercise the idea, its kind, the function's body."""

REWRITTEN = {
    "air_data": (
        (
            "the flow is split in world axes",
            "form",
            """
    flow = np.asarray(state[6:9]) - wind_world
    speed = np.linalg.norm(flow)
    return np.array([speed, np.arctan2(flow[2], flow[0]), np.arcsin(flow[1] / speed)])
""",
        ),
        (
            "the wind adds to the speed over the ground",
            "sign",
            """
    R = rotation_world_body(state[5], state[3], state[4])
    flow = R.T.dot(state[6:9]) + R.T.dot(wind_world)
    speed = np.linalg.norm(flow)
    return np.array([speed, np.arctan2(flow[2], flow[0]), np.arcsin(flow[1] / speed)])
""",
        ),
        (
            "the rotation is applied as it is, not backwards",
            "form",
            """
    R = rotation_world_body(state[5], state[3], state[4])
    flow = R.dot(state[6:9] - wind_world)
    speed = np.linalg.norm(flow)
    return np.array([speed, np.arctan2(flow[2], flow[0]), np.arcsin(flow[1] / speed)])
""",
        ),
    ),
    "body_force": (
        (
            "the induced drag grows with the lift coefficient, not with its square",
            "form",
            """
    V, a, b = air
    q = V * V
    cl = K["cL_0"] + K["cL_alpha"] * a
    cd = K["cD_0"] + K["cD_induced"] * cl
    T = (K["kT"] - K["kTV"] * V) * command[0]
    fx = q * (cl * np.sin(a) - cd * np.cos(a) * np.cos(b)) + T * np.cos(DOWN_THRUST)
    fy = q * (K["cY_beta"] * b - cd * np.sin(b))
    fz = -q * (cl * np.cos(a) + cd * np.sin(a) * np.cos(b)) + T * np.sin(DOWN_THRUST)
    return np.array([fx, fy, fz])
""",
        ),
        (
            "the thrust has the throttle's part in the wrong place: kT throttle - kTV V",
            "form",
            """
    V, a, b = air
    q = V * V
    cl = K["cL_0"] + K["cL_alpha"] * a
    cd = K["cD_0"] + K["cD_induced"] * cl**2
    T = K["kT"] * command[0] - K["kTV"] * V
    fx = q * (cl * np.sin(a) - cd * np.cos(a) * np.cos(b)) + T * np.cos(DOWN_THRUST)
    fy = q * (K["cY_beta"] * b - cd * np.sin(b))
    fz = -q * (cl * np.cos(a) + cd * np.sin(a) * np.cos(b)) + T * np.sin(DOWN_THRUST)
    return np.array([fx, fy, fz])
""",
        ),
    ),
    "state_rate": (
        (
            "the rates of the angles are the body rates",
            "form",
            """
    pitch, yaw, roll = state[3:6]
    p, q, r = rates_body
    lifted = rotation_world_body(roll, pitch, yaw) @ force_body
    lifted[2] -= GRAVITY
    return np.hstack([state[6:9], q, r, p, lifted])
""",
        ),
        (
            "the order of the angles is roll, pitch, yaw",
            "form",
            """
    pitch, yaw, roll = state[3:6]
    p, q, r = rates_body
    s, c = np.sin(roll), np.cos(roll)
    rates = [p + np.tan(pitch) * (q * s + r * c), q * c - r * s, (q * s + r * c) / np.cos(pitch)]
    pull = rotation_world_body(roll, pitch, yaw) @ force_body - np.array([0, 0, GRAVITY])
    return np.r_[state[6:9], rates, pull]
""",
        ),
    ),
    "rk4_step": (
        (
            "Heun's rule: the mean of the slopes at both ends",
            "form",
            """
    begin = rate(x, u_now)
    end = rate(x + dt * begin, u_next)
    return x + dt * (begin + end) / 2
""",
        ),
        (
            "the command is held over the whole step",
            "form",
            """
    a = rate(x, u_now)
    b = rate(x + a * dt / 2, u_now)
    c = rate(x + b * dt / 2, u_now)
    d = rate(x + c * dt, u_now)
    return x + (a + 2 * b + 2 * c + d) * dt / 6
""",
        ),
    ),
    "trim": (
        (
            "lift equals weight, whatever the thrust carries",
            "form",
            """
    alpha = (GRAVITY * np.cos(climb_angle) / airspeed**2 - K["cL_0"]) / K["cL_alpha"]
    cl = K["cL_0"] + K["cL_alpha"] * alpha
    drag = airspeed**2 * (K["cD_0"] + K["cD_induced"] * cl * cl)
    thrust = (drag + GRAVITY * np.sin(climb_angle)) / np.cos(alpha - DOWN_THRUST)
    throttle = thrust / (K["kT"] - K["kTV"] * airspeed)
    return np.array([alpha, throttle, -(K["M_0"] + K["M_alpha"] * alpha) / K["M_de"]])
""",
        ),
        (
            "one pass only, from no lift of the thrust",
            "form",
            """
    alpha, thrust = 0.0, 0.0
    for _ in range(2):
        lift = GRAVITY * np.cos(climb_angle) - thrust * np.sin(alpha - DOWN_THRUST)
        alpha = (lift / airspeed**2 - K["cL_0"]) / K["cL_alpha"]
        cl = lift / airspeed**2
        drag = airspeed**2 * (K["cD_0"] + K["cD_induced"] * cl**2)
        thrust = drag + GRAVITY * np.sin(climb_angle)
    throttle = thrust / (K["kT"] - K["kTV"] * airspeed)
    return np.array([alpha, throttle, -(K["M_0"] + K["M_alpha"] * alpha) / K["M_de"]])
""",
        ),
    ),
}
