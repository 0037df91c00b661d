"""Lab 6, rewritten with a wrong idea: of each exercise the idea, its kind, the function's body."""

REWRITTEN = {
    "marker_pose": (
        (
            "the homography's columns are scaled by the first alone and never made orthogonal",
            "form",
            """
    H = np.linalg.solve(K, homography(marker_square(size), corners_px))
    H = H / np.linalg.norm(H[:, 0])
    T_camera_marker = np.eye(4)
    T_camera_marker[:3, :3] = np.stack([H[:, 0], H[:, 1], np.cross(H[:, 0], H[:, 1])], axis=1)
    T_camera_marker[:3, 3] = H[:, 2]
    return np.linalg.inv(T_camera_marker)
""",
        ),
        (
            "gives the marker in the camera's axes",
            "form",
            """
    H = np.linalg.solve(K, homography(marker_square(size), corners_px))
    H = H / np.mean([np.linalg.norm(H[:, 0]), np.linalg.norm(H[:, 1])])
    U, _, Vt = np.linalg.svd(np.stack([H[:, 0], H[:, 1], np.cross(H[:, 0], H[:, 1])], axis=1))
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = U.dot(Vt), H[:, 2]
    return T
""",
        ),
    ),
    "fit_similarity": (
        (
            "the scale is the ratio of the mean distances from the origin",
            "form",
            """
    w = weights / weights.sum()
    mean_from, mean_to = (w[:, None] * p_from).sum(0), (w[:, None] * p_to).sum(0)
    H = (p_from - mean_from).T @ np.diag(w) @ (p_to - mean_to)
    U, _, Vt = np.linalg.svd(H)
    R = Vt.T @ np.diag([1, 1, np.linalg.det(Vt.T @ U.T)]) @ U.T
    scale = np.linalg.norm(p_to, axis=1).mean() / np.linalg.norm(p_from, axis=1).mean()
    return scale, R, mean_to - scale * R @ mean_from
""",
        ),
        (
            "the rotation takes the second set to the first",
            "form",
            """
    w = weights / weights.sum()
    mean_from, mean_to = (w[:, None] * p_from).sum(0), (w[:, None] * p_to).sum(0)
    a, b = p_from - mean_from, p_to - mean_to
    U, S, Vt = np.linalg.svd(a.T @ np.diag(w) @ b)
    flip = np.array([1, 1, np.linalg.det(U @ Vt)])
    R = U * flip @ Vt
    scale = (S * flip).sum() / (w * (a * a).sum(1)).sum()
    return scale, R, mean_to - scale * R @ mean_from
""",
        ),
    ),
    "reject_outliers": (
        (
            "the candidate with the most points inside a gate of one metre",
            "form",
            """
    best, most, kept = 0, -1, None
    for i, (scale, R, t) in enumerate(candidates):
        misses = np.linalg.norm(scale * (R @ p_from.T).T + t - p_to, axis=1)
        inside = misses < 1.0
        if inside.sum() > most:
            best, most, kept = i, inside.sum(), inside
    return best, kept
""",
        ),
        (
            "the root mean square miss decides, which outliers rule",
            "form",
            """
    every = []
    for scale, R, t in candidates:
        every.append(np.linalg.norm(scale * (R @ p_from.T).T + t - p_to, axis=1))
    every = np.array(every)
    best = int(np.argmin(np.sqrt((every**2).mean(axis=1))))
    return best, every[best] <= COHORT["gate"] * np.median(every[best])
""",
        ),
    ),
    "triangulate": (
        (
            "the mean of the points half way between pairs of rays, without weights",
            "form",
            """
    d = rays / np.linalg.norm(rays, axis=1)[:, None]
    A, b = np.zeros((3, 3)), np.zeros(3)
    for c, u in zip(centres, d):
        M = np.eye(3) - np.outer(u, u)
        A, b = A + M, b + M @ c
    p = np.linalg.inv(A) @ b
    return p, np.array([np.linalg.norm(np.cross(u, p - c)) for c, u in zip(centres, d)])
""",
        ),
        (
            "the misses are angles, not distances",
            "form",
            """
    d = rays / np.linalg.norm(rays, axis=1)[:, None]
    A, b = np.zeros((3, 3)), np.zeros(3)
    for w, c, u in zip(weights, centres, d):
        M = w * (np.eye(3) - np.outer(u, u))
        A, b = A + M, b + M @ c
    p = np.linalg.inv(A) @ b
    misses = []
    for c, u in zip(centres, d):
        misses.append(np.linalg.norm(np.cross(u, p - c)) / np.linalg.norm(p - c))
    return p, np.array(misses)
""",
        ),
    ),
}
