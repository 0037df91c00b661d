"""Lab 12, rewritten with a wrong idea: of each exercise the idea, its kind, the function's body."""

REWRITTEN = {
    "residual_map": (
        (
            "the square of the mean residual, in which noise cancels",
            "form",
            """
    def cells(values, at):
        out = np.full((values.shape[1], len(edges) - 1), np.nan)
        for j in range(values.shape[1]):
            for i in range(len(edges) - 1):
                last = i == len(edges) - 2
                above = at <= edges[i + 1] if last else at < edges[i + 1]
                x = values[(at >= edges[i]) & above & np.isfinite(values[:, j]), j]
                if len(x) >= fewest:
                    out[j, i] = np.mean(x) ** 2
        return out

    return cells(residual, variable) - cells(calm_residual, calm_variable)
""",
        ),
        (
            "the ratio of the two, not their difference",
            "form",
            """
    def cells(values, at):
        out = np.full((values.shape[1], len(edges) - 1), np.nan)
        for j in range(values.shape[1]):
            for i in range(len(edges) - 1):
                last = i == len(edges) - 2
                above = at <= edges[i + 1] if last else at < edges[i + 1]
                x = values[(at >= edges[i]) & above & np.isfinite(values[:, j]), j]
                if len(x) >= fewest:
                    out[j, i] = np.mean(x**2)
        return out

    return cells(residual, variable) / cells(calm_residual, calm_variable)
""",
        ),
    ),
    "augment_model": (
        (
            "more drag along the body's nose instead of along the path",
            "form",
            """
    out = np.array(loads, dtype=float)
    V2, a, b = flow["V"] ** 2, flow["alpha"], flow["beta"]
    path = np.array([np.cos(a) * np.cos(b), np.sin(b), np.sin(a) * np.cos(b)])
    up = np.array([np.sin(a), 0 * a, -np.cos(a)])
    if effect == "extra_drag":
        out[0] -= size * V2
    if effect == "thrust_loss":
        out[0] -= size * flow["thrust"]
    if effect == "ground_effect":
        k = size * np.exp(-flow["height"] / CUSHION_M) * V2
        out[:3] += k * (flow["c"] * up + K["cD_induced"] * flow["c"] ** 2 * path)
    if effect == "aileron_loss":
        out[3] -= size * V2 * K["L_da"] * flow["aileron"]
    if effect == "adverse_yaw":
        out[5] -= size * V2 * flow["aileron"]
    return out
""",
        ),
        (
            "the cushion gives lift and takes no drag",
            "form",
            """
    out = np.array(loads, dtype=float)
    V2, a, b = flow["V"] ** 2, flow["alpha"], flow["beta"]
    path = np.array([np.cos(a) * np.cos(b), np.sin(b), np.sin(a) * np.cos(b)])
    up = np.array([np.sin(a), 0 * a, -np.cos(a)])
    if effect == "extra_drag":
        out[:3] -= size * V2 * path
    if effect == "thrust_loss":
        out[0] -= size * flow["thrust"]
    if effect == "ground_effect":
        out[:3] += size * np.exp(-flow["height"] / CUSHION_M) * V2 * flow["c"] * up
    if effect == "aileron_loss":
        out[3] -= size * V2 * K["L_da"] * flow["aileron"]
    if effect == "adverse_yaw":
        out[5] -= size * V2 * flow["aileron"]
    return out
""",
        ),
    ),
    "score_candidates": (
        (
            "the effect is fitted to what the parameters leave, not together with them",
            "form",
            """
    prior = np.zeros((J.shape[1], J.shape[1])) + precision
    step = -np.linalg.solve(J.T @ J + prior, J.T @ r + prior @ away)
    left = r + J @ step
    answer = {}
    for name, E in candidates.items():
        size = -np.linalg.lstsq(E, left, rcond=None)[0]
        chi2 = np.sum((left + E @ size) ** 2) - np.sum(left**2)
        answer[name] = np.r_[-chi2 / scatter - E.shape[1] * np.log(len(r)), size]
    return answer
""",
        ),
        (
            "more numbers cost two each, not the logarithm of the rows",
            "form",
            """
    F = J.shape[1]

    def solved(A):
        P, shift = np.zeros((A.shape[1],) * 2), np.zeros(A.shape[1])
        P[:F, :F], shift[:F] = precision, precision @ away
        g = A.T @ r + shift
        x = -np.linalg.solve(A.T @ A + P, g)
        return g @ x, x

    base = solved(J)[0]
    answer = {}
    for name, E in candidates.items():
        q, x = solved(np.c_[J, E])
        answer[name] = np.r_[(base - q) / scatter - 2 * E.shape[1], x[F:]]
    return answer
""",
        ),
    ),
    "verdict": (
        (
            "the mean of the baseline's gains sets the threshold",
            "form",
            """
    threshold = max(LEAST_GAIN, CAUTION * float(np.mean(calm_gains)))
    best = max(gains, key=gains.get)
    if gains[best] <= threshold:
        return threshold, "none", ()
    near = [name for name in gains if gains[name] > gains[best] - LEAST_GAIN]
    near.sort(key=gains.get, reverse=True)
    return threshold, ("ambiguous" if len(near) > 1 else "named"), tuple(near)
""",
        ),
        (
            "all that pass the threshold are named together",
            "form",
            """
    threshold = max(LEAST_GAIN, CAUTION * float(np.max(calm_gains)))
    passing = sorted((n for n in gains if gains[n] > threshold), key=lambda n: -gains[n])
    if not passing:
        return threshold, "none", ()
    return threshold, ("named" if len(passing) == 1 else "ambiguous"), tuple(passing)
""",
        ),
    ),
    "my_finding": (
        (
            "another effect of about the same size",
            "form",
            """
    return dict(effect="extra_drag", size=0.455, low=0.427, high=0.483)
""",
        ),
        (
            "the ends of the interval as distances from the size",
            "form",
            """
    return dict(effect="ground_effect", size=0.455, low=-0.028, high=0.028)
""",
        ),
    ),
    "estimate_wind": (
        (
            "the mean velocity over the ground is the wind",
            "form",
            """
    good = ~np.isnan(v).any(axis=1)
    wind = v[good].mean(axis=0)
    forward = np.column_stack([np.cos(yaw[good]), -np.sin(yaw[good])])
    right = np.column_stack([-np.sin(yaw[good]), -np.cos(yaw[good])])
    rest = v[good] - wind
    return np.array([(rest * forward).sum(1).mean(), (rest * right).sum(1).mean(), *wind])
""",
        ),
        (
            "yaw is counted to the left, as in a mathematics book",
            "form",
            """
    good = ~np.isnan(v).any(axis=1)
    A, b = [], []
    for (vx, vy), angle in zip(v[good], yaw[good]):
        A += [[np.cos(angle), -np.sin(angle), 1, 0], [np.sin(angle), np.cos(angle), 0, 1]]
        b += [vx, vy]
    return np.linalg.lstsq(np.array(A), np.array(b), rcond=None)[0]
""",
        ),
    ),
}
