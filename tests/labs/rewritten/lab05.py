"""Lab 5, rewritten with a wrong idea: of each exercise the idea, its kind, the function's body."""

REWRITTEN = {
    "local_slope": (
        (
            "the slope between the first and the last row of the window",
            "form",
            """
    slope, noise = np.full(len(t), np.nan), np.full(len(t), np.nan)
    for k in range(len(t)):
        first, last = max(k - half, 0), min(k + half, len(t) - 1)
        good = [i for i in range(first, last + 1) if np.isfinite(x[i])]
        if len(good) > 1:
            span = t[good[-1]] - t[good[0]]
            slope[k] = (x[good[-1]] - x[good[0]]) / span
            noise[k] = np.sqrt(2) / span
    return slope, noise
""",
        ),
        (
            "a line through the window's first value, not a free one",
            "form",
            """
    slope, noise = np.full(len(t), np.nan), np.full(len(t), np.nan)
    for k in range(len(t)):
        good = [i for i in range(len(t)) if abs(i - k) <= half and np.isfinite(x[i])]
        if len(good) > 1:
            tau = t[good] - t[good[0]]
            slope[k] = np.sum(tau * (x[good] - x[good[0]])) / np.sum(tau**2)
            noise[k] = 1 / np.sqrt(np.sum(tau**2))
    return slope, noise
""",
        ),
    ),
    "residuals": (
        (
            "each row is divided by its length, a norm of all channels",
            "form",
            """
    e = (predicted - measured) / sigma
    known = np.all(np.isfinite(e), axis=-1)
    e = np.where(known[..., None], e, 0)
    size = np.linalg.norm(e, axis=-1, keepdims=True)
    weight = np.sqrt(FAR / np.maximum(size, FAR)) * known[..., None]
    return weight * e, weight / sigma
""",
        ),
        (
            "Huber's weight itself, not its root, on both",
            "form",
            """
    e = (predicted - measured) / sigma
    known = np.all(np.isfinite(e), axis=-1, keepdims=True)
    e = np.where(known, e, 0)
    worst = np.max(np.abs(e), axis=-1, keepdims=True)
    weight = np.where(worst > FAR, FAR / np.maximum(worst, 1e-9), 1.0) * known
    return weight * e, weight / sigma
""",
        ),
    ),
    "gauss_newton_step": (
        (
            "the start states are fitted first and then left alone",
            "form",
            """
    windows = len(r)
    dstart = np.array([-np.linalg.lstsq(J_start[i], r[i], rcond=None)[0] for i in range(windows)])
    left = np.array([r[i] + J_start[i] @ dstart[i] for i in range(windows)]).ravel()
    J = J_K.reshape(len(left), -1)
    normal = J.T @ J + np.diag(sigma_prior**-2.0)
    return -np.linalg.solve(normal, J.T @ left + away / sigma_prior**2), dstart
""",
        ),
        (
            "steepest descent on the prior's scale, no matrix is solved for K",
            "form",
            """
    dK_scale = sigma_prior**2
    gradient = away / sigma_prior**2
    for i in range(len(r)):
        Q, _ = np.linalg.qr(J_start[i])
        gradient = gradient + (J_K[i] - Q @ (Q.T @ J_K[i])).T @ (r[i] - Q @ (Q.T @ r[i]))
    dK = -dK_scale * gradient
    dstart = np.array([
        -np.linalg.lstsq(J_start[i], r[i] + J_K[i] @ dK, rcond=None)[0] for i in range(len(r))
    ])
    return dK, dstart
""",
        ),
    ),
    "intervals": (
        (
            "the sum of squares divided by all that was measured",
            "form",
            """
    spread = np.linalg.norm(r) / np.sqrt(measured_count)
    cov = np.linalg.inv(J.T @ J)
    width = Z * spread * np.sqrt(np.diagonal(cov))
    return np.array([K - width, K + width]).T
""",
        ),
        (
            "the information's diagonal, each parameter for itself, and rows as low over high",
            "form",
            """
    left = measured_count - K.size - start_count
    spread = np.sqrt(r @ r / left)
    width = Z * spread / np.linalg.norm(J, axis=0)
    return np.vstack([K - width, K + width]).T
""",
        ),
    ),
    "holdout_score": (
        (
            "the mean of the absolute errors",
            "form",
            """
    chosen = np.array([number in list(held_passes) for number in of_pass])
    e = predicted[chosen] - measured[chosen]
    e = e[~np.isnan(e).any(axis=-1)]
    return np.array([np.abs(np.hypot(e[:, 0], e[:, 1])).mean(), np.rad2deg(np.abs(e[:, 2]).mean())])
""",
        ),
        (
            "the spread about the mean error, which hides a bias",
            "form",
            """
    chosen = np.array([number in list(held_passes) for number in of_pass])
    e = predicted[chosen] - measured[chosen]
    e = e[~np.isnan(e).any(axis=-1)]
    return np.array([np.sqrt(e[:, 0].var() + e[:, 1].var()), np.rad2deg(e[:, 2].std())])
""",
        ),
    ),
    "forecast_turn": (
        (
            "ten small steps along the tangent, the course after each step",
            "form",
            """
    place = np.array(p, dtype=float)
    speed = np.sqrt(v[:, 0] ** 2 + v[:, 1] ** 2)
    rate = GRAVITY * np.tan(roll) / speed
    course = np.arctan2(v[:, 1], v[:, 0])
    for _ in range(10):
        course = course - rate * horizon / 10
        move = np.column_stack([speed * np.cos(course), speed * np.sin(course), v[:, 2]])
        place = place + move * horizon / 10
    return place, rate * horizon
""",
        ),
        (
            "the circle's middle lies to the left",
            "sign",
            """
    speed = np.hypot(v[:, 0], v[:, 1])
    turned = -GRAVITY * np.tan(roll) * horizon / speed
    chord = speed * horizon * np.sinc(turned / (2 * np.pi))
    course = np.arctan2(v[:, 1], v[:, 0]) - turned / 2
    moved = np.column_stack([chord * np.cos(course), chord * np.sin(course), v[:, 2] * horizon])
    return p + moved, turned
""",
        ),
    ),
}
