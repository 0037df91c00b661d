"""Lab 9, rewritten with a wrong idea: of each exercise the idea, its kind, the function's body."""

REWRITTEN = {
    "ellipsoid_mask": (
        (
            "the distance along the ray's length is compared with the depth",
            "form",
            """
    rows, columns = hall_depth.shape
    mask = np.zeros((rows, columns), bool)
    R, t = T_camera_body[:3, :3], T_camera_body[:3, 3]
    for i in range(rows):
        for j in range(columns):
            ray = np.array([(j + 0.5 - columns / 2) / focal_px, (i + 0.5 - rows / 2) / focal_px, 1])
            length = np.linalg.norm(ray)
            e, o = R.T @ ray / length / half_axes, (-R.T @ t - centre_body) / half_axes
            a, b, c = e @ e, e @ o, o @ o - 1
            if b * b >= a * c:
                entry = (-b - np.sqrt(b * b - a * c)) / a
                mask[i, j] = 0 < entry < hall_depth[i, j]
    return mask
""",
        ),
        (
            "the whole ellipsoid is in front if its centre is",
            "form",
            """
    rows, columns = hall_depth.shape
    i, j = np.mgrid[:rows, :columns] + 0.5
    rays = np.dstack([(j - columns / 2) / focal_px, (i - rows / 2) / focal_px, np.ones_like(i)])
    R, t = T_camera_body[:3, :3], T_camera_body[:3, 3]
    centre = R @ centre_body + t
    e, o = rays @ R / half_axes, -(R.T @ centre) / half_axes
    a, b, c = (e**2).sum(-1), (e * o).sum(-1), (o**2).sum() - 1
    return (b**2 >= a * c) & (centre[2] > 0) & (centre[2] < hall_depth)
""",
        ),
    ),
    "iou": (
        (
            "twice the overlap over the sum of sizes, Dice",
            "form",
            """
    marked = probability > threshold
    overlap, alarm = [], []
    for m, t in zip(marked, truth):
        sizes = m.sum() + t.sum()
        overlap.append(2 * (m & t).sum() / sizes if sizes else 1.0)
        alarm.append(bool(not t.any() and m.sum() >= MIN_PIXELS))
    return np.array(overlap), np.array(alarm)
""",
        ),
        (
            "one number over all pictures' pixels",
            "form",
            """
    marked = probability > threshold
    total = (marked | truth).sum()
    share = (marked & truth).sum() / total if total else 1.0
    alarm = [not t.any() and m.sum() >= MIN_PIXELS for m, t in zip(marked, truth)]
    return np.full(len(truth), share), np.array(alarm, dtype=bool)
""",
        ),
    ),
    "mask_loss": (
        (
            "the overlap over the whole batch at once",
            "form",
            """
    weight = torch.tensor(float(POS_WEIGHT))
    entropy = torch.nn.functional.binary_cross_entropy_with_logits(
        logits, truth, pos_weight=weight
    )
    p = logits.sigmoid()
    dice = (2 * (p * truth).sum() + 1) / (p.sum() + truth.sum() + 1)
    return entropy + DICE_WEIGHT * (1 - dice)
""",
        ),
        (
            "the weight on all pixels and the overlap of the marked ones",
            "form",
            """
    entropy = POS_WEIGHT * torch.nn.functional.binary_cross_entropy_with_logits(logits, truth)
    p = (logits > 0).to(logits.dtype)
    both, sizes = (p * truth).sum((1, 2)), (p + truth).sum((1, 2))
    return entropy + DICE_WEIGHT * (1 - ((2 * both + 1) / (sizes + 1)).mean())
""",
        ),
    ),
    "randomize": (
        (
            "the patch covers the leader too",
            "form",
            """
    out = np.array(image, dtype=np.float64)
    r, c = corner
    h = min(patch.shape[0], out.shape[0] - r)
    w = min(patch.shape[1], out.shape[1] - c)
    out[r : r + h, c : c + w] = patch[:h, :w]
    out[mask] = out[mask] * tint
    out[mask & (draws < salt / 2)] = 0
    out[mask & (draws > 1 - salt / 2)] = 255
    out = out * brightness ** (1 / GAMMA)
    return np.clip(np.rint(out), 0, 255).astype(np.uint8)
""",
        ),
        (
            "the levels are multiplied as if they were light",
            "form",
            """
    out = np.array(image, dtype=np.float64)
    r, c = corner
    h = min(patch.shape[0], out.shape[0] - r)
    w = min(patch.shape[1], out.shape[1] - c)
    keep = mask[r : r + h, c : c + w, None]
    out[r : r + h, c : c + w] = np.where(keep, out[r : r + h, c : c + w], patch[:h, :w])
    out = np.where(mask[..., None], out * tint, out)
    out[mask & (draws < salt / 2)] = 0
    out[mask & (draws > 1 - salt / 2)] = 255
    return np.clip(np.rint(out * brightness), 0, 255).astype(np.uint8)
""",
        ),
    ),
}
