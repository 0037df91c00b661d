"""Lab 9: wrong solutions that students write.

Each must lose points and be seen by a public check.
"""

MUTANTS = {
    "ellipsoid_mask": (
        (
            "pixel corners for pixel centres",
            "np.indices((height, width)) + 0.5",
            "np.indices((height, width))",
        ),
        (
            "turned the wrong way",
            "rays @ R_camera_body / half_axes",
            "rays @ R_camera_body.T / half_axes",
        ),
        ("centre with the wrong sign", "- centre_body) / half_axes", "+ centre_body) / half_axes"),
        (
            "rows and columns mixed up",
            "(column - width / 2) / focal_px, (row - height / 2) / focal_px",
            "(row - height / 2) / focal_px, (column - width / 2) / focal_px",
        ),
        ("what is behind the camera is seen", " & (entry > 0.0)", ""),
        ("nothing hides", " & (entry < hall_depth)", ""),
        ("exit in place of entry", "(-b - np.sqrt", "(-b + np.sqrt"),
        (
            "multiplied by the half axes",
            "e = rays @ R_camera_body / half_axes",
            "e = rays @ R_camera_body * half_axes",
        ),
        (
            "discriminant of the other formula",
            "inside = b * b - a * c",
            "inside = b * b - 4.0 * a * c",
        ),
        (
            "distance along the ray in place of depth",
            "(entry < hall_depth)",
            "(entry * np.linalg.norm(rays, axis=-1) < hall_depth)",
        ),
    ),
    "iou": (
        (
            "Dice in place of IoU",
            "both / np.maximum(either, 1)",
            "2 * both / np.maximum(either + both, 1)",
        ),
        ("empty pictures count as 0", "np.maximum(either, 1), 1.0)", "np.maximum(either, 1), 0.0)"),
        (
            "one number for all",
            "np.sum(marked & truth, axis=(1, 2))",
            "np.sum(marked & truth) + 0 * np.sum(marked, axis=(1, 2))",
        ),
        ("threshold included", "probability > threshold", "probability >= threshold"),
        ("threshold written in", "probability > threshold", "probability > 0.5"),
        ("more than MIN_PIXELS", ">= MIN_PIXELS", "> MIN_PIXELS"),
        ("any pixel alarms", ">= MIN_PIXELS", ">= 1"),
        ("alarm with a leader in view", "~truth.any(axis=(1, 2)) & ", "(both == 0) & "),
        ("by the truth alone", "np.sum(marked | truth, axis=(1, 2))", "np.sum(truth, axis=(1, 2))"),
    ),
    "mask_loss": (
        (
            "logarithm of a rounded probability",
            "torch.nn.functional.logsigmoid(logits)\n"
            "    log_hall = torch.nn.functional.logsigmoid(-logits)",
            "torch.log(torch.sigmoid(logits))\n"
            "    log_hall = torch.log(1.0 - torch.sigmoid(logits))",
        ),
        ("weight forgotten", "POS_WEIGHT * truth", "truth"),
        (
            "weight on the hall",
            "POS_WEIGHT * truth * log_leader + (1.0 - truth)",
            "truth * log_leader + POS_WEIGHT * (1.0 - truth)",
        ),
        (
            "Dice over the whole batch",
            "(p * truth).sum(dim=(1, 2))\n    sizes = p.sum(dim=(1, 2)) + truth.sum(dim=(1, 2))",
            "(p * truth).sum()\n    sizes = p.sum() + truth.sum()",
        ),
        (
            "without the ones",
            "(2.0 * both + 1.0) / (sizes + 1.0)",
            "(2.0 * both + 1e-9) / (sizes + 1e-9)",
        ),
        ("factor 2 forgotten", "(2.0 * both", "(1.0 * both"),
        ("Dice of logits", "p = torch.sigmoid(logits)", "p = logits"),
        ("sign of the entropy", "entropy = -(", "entropy = ("),
        (
            "Dice of a hard mask has no gradient",
            "p = torch.sigmoid(logits)",
            "p = (logits > 0).to(logits.dtype)",
        ),
        ("overlap in place of what is missing", "(1.0 - overlap).mean()", "overlap.mean()"),
        (
            "weight of the Dice part forgotten",
            "DICE_WEIGHT * (1.0 - overlap)",
            "0.9 * DICE_WEIGHT * (1.0 - overlap)",
        ),
    ),
    "randomize": (
        (
            "patch covers the leader",
            "free = ~mask[row : row + patch.shape[0], column : column + patch.shape[1]]",
            "free = np.ones(under.shape[:2], bool)",
        ),
        ("8-bit arithmetic", "image.astype(float)", "image.copy()"),
        ("row and column swapped", "row, column = corner", "column, row = corner"),
        ("tint on the whole picture", "picture[mask] *= tint", "picture *= tint"),
        (
            "salt on the whole picture",
            "mask & (draws > 1.0 - salt / 2)",
            "(draws > 1.0 - salt / 2)",
        ),
        ("too much pepper", "draws < salt / 2", "draws < salt"),
        ("no gamma", "brightness ** (1.0 / GAMMA)", "brightness"),
        ("gamma the wrong way round", "brightness ** (1.0 / GAMMA)", "brightness**GAMMA"),
        (
            "cut off, not rounded",
            "np.round(np.clip(picture, 0.0, 255.0))",
            "np.clip(picture, 0.0, 255.0)",
        ),
        (
            "wraps beyond 255",
            "np.round(np.clip(picture, 0.0, 255.0)).astype(np.uint8)",
            "np.round(picture).astype(int).astype(np.uint8)",
        ),
        (
            "salt is tinted",
            "    picture[mask] *= tint\n"
            "    picture[mask & (draws < salt / 2)] = 0.0\n"
            "    picture[mask & (draws > 1.0 - salt / 2)] = 255.0\n",
            "    picture[mask & (draws < salt / 2)] = 0.0\n"
            "    picture[mask & (draws > 1.0 - salt / 2)] = 255.0\n"
            "    picture[mask] *= tint\n",
        ),
    ),
}
