"""Wrong solutions of lab 6: what is wrong, the replaced text, the replacement."""

MUTANTS = {
    "marker_pose": (
        (
            "the marker in the camera, not inverted",
            "T_marker_camera[:3, :3] = R_camera_marker.T\n",
            "T_marker_camera[:3, :3] = R_camera_marker\n",
        ),
        (
            "the inverse of the place is only its negative",
            "-R_camera_marker.T @ p_camera_marker",
            "-p_camera_marker",
        ),
        ("V of the SVD, where NumPy already gives its transpose", "U @ Vt,", "U @ Vt.T,"),
        ("the sign of the inverse is lost", "= -R_camera_marker.T @", "= R_camera_marker.T @"),
        (
            "left-handed: the third column turned round",
            "np.cross(A[:, 0], A[:, 1])",
            "np.cross(A[:, 1], A[:, 0])",
        ),
        (
            "divided by the sum of both lengths",
            "(0.5 * np.linalg.norm(A[:, 0]) + 0.5 *",
            "(np.linalg.norm(A[:, 0]) +",
        ),
        ("K is forgotten", "np.linalg.inv(K) @ homography", "homography"),
        ("K instead of its inverse", "np.linalg.inv(K)", "K"),
        ("the size of another marker", "marker_square(size)", "marker_square(0.8)"),
        (
            "the columns are left as they are",
            "U @ Vt, A[:, 2]",
            "np.column_stack([A[:, 0], A[:, 1], np.cross(A[:, 0], A[:, 1])]), A[:, 2]",
        ),
        (
            "only one of the two lengths",
            "(0.5 * np.linalg.norm(A[:, 0]) + 0.5 * np.linalg.norm(A[:, 1]))",
            "np.linalg.norm(A[:, 0])",
        ),
    ),
    "fit_similarity": (
        ("the rotation the wrong way round", "(w[:, None] * b).T @ a)", "(w[:, None] * a).T @ b)"),
        (
            "rigid: no scale",
            "scale = np.sum(S * np.diag(D)) / np.sum(w * np.sum(a**2, axis=1))",
            "scale = 1.0",
        ),
        ("mirrors are let through", "np.linalg.det(U @ Vt)", "1.0"),
        ("plain means", "w @ p_from, w @ p_to", "np.mean(p_from, axis=0), np.mean(p_to, axis=0)"),
        ("weights are left out of M", "(w[:, None] * b).T @ a", "b.T @ a / len(a)"),
        (
            "weights are left out of the scale",
            "np.sum(w * np.sum(a**2, axis=1))",
            "np.mean(np.sum(a**2, axis=1))",
        ),
        ("the scale by the other set", "np.sum(a**2, axis=1)", "np.sum(b**2, axis=1)"),
        (
            "the scale is left out of the shift",
            "mean_to - scale * R @ mean_from",
            "mean_to - R @ mean_from",
        ),
        ("the mirror's sign is left out of the scale", "np.sum(S * np.diag(D))", "np.sum(S)"),
    ),
    "reject_outliers": (
        ("mean instead of median", "medians = np.median(", "medians = np.mean("),
        ("the smallest single miss", "medians = np.median(", "medians = np.min("),
        ("the worst candidate", "np.argmin(medians)", "np.argmax(medians)"),
        ("the rotation turned round", "p_from @ R.T + t", "p_from @ R + t"),
        ("the gate in metres", "* medians[best]", "* 1.0"),
        ("the outliers are kept", "misses[best] <=", "misses[best] >"),
        ("the gate of another course", 'COHORT["gate"]', "5.0"),
        ("the misses of the last candidate", "keep = misses[best]", "keep = misses[-1]"),
        (
            "medians over candidates instead of points",
            "np.median(misses, axis=1)",
            "np.median(misses, axis=0)",
        ),
    ),
    "triangulate": (
        (
            "directions are taken for unit vectors",
            "rays / np.linalg.norm(rays, axis=1, keepdims=True)",
            "1.0 * rays",
        ),
        (
            "one length for all",
            "np.linalg.norm(rays, axis=1, keepdims=True)",
            "np.linalg.norm(rays)",
        ),
        ("weights on one side only", "np.sum(weights[:, None] * np.einsum", "np.sum(np.einsum"),
        (
            "no weights",
            "left = np.sum(weights[:, None, None] * across",
            "weights = np.ones(len(d))\n    left = np.sum(across",
        ),
        (
            "along the ray instead of across",
            "np.eye(3) - d[:, :, None] * d[:, None, :]",
            "d[:, :, None] * d[:, None, :] + 1e-6 * np.eye(3)",
        ),
        (
            "misses are distances from the cameras",
            'np.linalg.norm(np.einsum("nij,nj->ni", across, p - centres), axis=1)',
            "np.linalg.norm(p - centres, axis=1)",
        ),
        (
            "misses of the unweighted sum",
            "across, p - centres), axis=1)",
            "across, p - centres), axis=0)",
        ),
    ),
}
