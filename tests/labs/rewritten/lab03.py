"""Lab 3, rewritten with a wrong idea: of each exercise the idea, its kind, the function's body."""

REWRITTEN = {
    "cov3d_from_scale_quat": (
        (
            "the scales enter once, not squared",
            "form",
            """
    q = quaternions_xyzw / np.sqrt((quaternions_xyzw**2).sum(1))[:, None]
    covs = []
    for (x, y, z, w), s in zip(q, np.exp(log_scales)):
        R = np.array([
            [1 - 2 * y * y - 2 * z * z, 2 * x * y - 2 * w * z, 2 * x * z + 2 * w * y],
            [2 * x * y + 2 * w * z, 1 - 2 * x * x - 2 * z * z, 2 * y * z - 2 * w * x],
            [2 * x * z - 2 * w * y, 2 * y * z + 2 * w * x, 1 - 2 * x * x - 2 * y * y],
        ])
        covs.append(R @ np.diag(s) @ R.T)
    return np.array(covs)
""",
        ),
        (
            "turns the wrong way: the matrix of the conjugate",
            "form",
            """
    q = quaternions_xyzw / np.linalg.norm(quaternions_xyzw, axis=-1)[:, None]
    v, w = -q[:, :3], q[:, 3]
    covs = np.empty((len(q), 3, 3))
    for i in range(len(q)):
        x, y, z = v[i]
        skew = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
        R = np.eye(3) + 2 * w[i] * skew + 2 * skew @ skew
        covs[i] = R @ np.diag(np.exp(log_scales[i]) ** 2) @ R.T
    return covs
""",
        ),
    ),
    "project_gaussians": (
        (
            "the matrix of a camera at infinite distance, no slant",
            "form",
            """
    fx, fy = lens["fx"], lens["fy"]
    depth = means_camera[:, 2]
    px = np.column_stack([
        lens["cx"] - fx * means_camera[:, 0] / depth,
        lens["cy"] + fy * means_camera[:, 1] / depth,
    ])
    covs = np.empty((len(depth), 2, 2))
    for i, z in enumerate(depth):
        J = np.array([[-fx / z, 0, 0], [0, fy / z, 0]])
        covs[i] = J @ covs_camera[i] @ J.T + blur_px2 * np.eye(2)
    return px, covs
""",
        ),
        (
            "the blur is added to every entry",
            "form",
            """
    fx, fy = lens["fx"], lens["fy"]
    px, covs = [], []
    for (x, y, z), cov in zip(means_camera, covs_camera):
        J = np.array([[-fx / z, 0, fx * x / z**2], [0, fy / z, -fy * y / z**2]])
        px.append([lens["cx"] - fx * x / z, lens["cy"] + fy * y / z])
        covs.append(J @ cov @ J.T + blur_px2)
    return np.array(px), np.array(covs)
""",
        ),
    ),
    "splat_alphas": (
        (
            "the squared distance for the Mahalanobis distance in the cut",
            "form",
            """
    out = np.zeros((len(pixels), len(means_px)))
    for j, (mean, cov) in enumerate(zip(means_px, covs_px)):
        d = pixels - mean
        square = np.sum(d @ np.linalg.inv(cov) * d, axis=1)
        alpha = np.clip(opacities[j] * np.exp(-square / 2), None, 0.999)
        alpha[np.sum(d * d, axis=1) > COHORT["cut_sigma"] ** 2] = 0
        out[:, j] = alpha
    return out
""",
        ),
        (
            "the covariance itself instead of its inverse",
            "form",
            """
    out = np.zeros((len(pixels), len(means_px)))
    for j, (mean, cov) in enumerate(zip(means_px, covs_px)):
        d = pixels - mean
        square = ((d @ cov) * d).sum(axis=1)
        alpha = np.minimum(opacities[j] * np.exp(-square / 2), 0.999)
        out[:, j] = np.where(square > COHORT["cut_sigma"] ** 2, 0, alpha)
    return out
""",
        ),
    ),
    "alpha_composite": (
        (
            "from the back to the front, as if the last splat were nearest",
            "form",
            """
    far_first = np.argsort(-depths)
    a, c, d = alphas[:, far_first], colours[far_first], depths[far_first]
    light = np.ones(len(a))
    rgb = np.zeros((len(a), 3))
    depth = np.full(len(a), np.nan)
    for j in range(a.shape[1]):
        rgb += (light * a[:, j])[:, None] * c[j]
        light = light * (1 - a[:, j])
        fresh = np.isnan(depth) & (1 - light >= COHORT["surface_share"])
        depth[fresh] = d[j]
    return rgb + light[:, None] * background, depth
""",
        ),
        (
            "the depth is the mean over the light",
            "form",
            """
    near_first = np.argsort(depths)
    a, c, d = alphas[:, near_first], colours[near_first], depths[near_first]
    light = np.ones(len(a))
    rgb, depth = np.zeros((len(a), 3)), np.zeros(len(a))
    for j in range(a.shape[1]):
        rgb += (light * a[:, j])[:, None] * c[j]
        depth += light * a[:, j] * d[j]
        light = light * (1 - a[:, j])
    rgb += light[:, None] * background
    return rgb, np.where(1 - light >= COHORT["surface_share"], depth / (1 - light), np.nan)
""",
        ),
    ),
}
