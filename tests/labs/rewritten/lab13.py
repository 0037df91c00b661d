"""Lab 13, rewritten with a wrong idea: of each exercise the idea, its kind, the function's body."""

REWRITTEN = {
    "merge_gaussians": (
        (
            "the mean of the covariances alone, without the spread of the centres",
            "form",
            """
    merged = [], [], []
    for g in range(groups.max() + 1):
        mine = groups == g
        for out, values in zip(merged, (means, covs, colours)):
            out.append(np.average(values[mine], axis=0, weights=weights[mine]))
    return tuple(np.array(out) for out in merged)
""",
        ),
        (
            "every Gaussian counts the same",
            "form",
            """
    places, shapes, paints = [], [], []
    for g in range(groups.max() + 1):
        mine = groups == g
        centre = means[mine].mean(axis=0)
        off = means[mine] - centre
        places.append(centre)
        shapes.append((covs[mine] + np.einsum("ni,nj->nij", off, off)).mean(axis=0))
        paints.append(colours[mine].mean(axis=0))
    return np.array(places), np.array(shapes), np.array(paints)
""",
        ),
    ),
    "sticks_from_slots": (
        (
            "the throttle stays between -1 and 1",
            "form",
            """
    stick = {}
    for letter, slot in zip(order, slots_us):
        stick[letter] = max(-1.0, min(1.0, (slot - centre_us) / reach_us))
    return np.array([stick[letter] for letter in "TAER"])
""",
        ),
        (
            "the slots are taken in the sender's order",
            "form",
            """
    stick = [max(-1.0, min(1.0, (slot - centre_us) / reach_us)) for slot in slots_us]
    stick[0] = (stick[0] + 1) / 2
    return np.array(stick)
""",
        ),
    ),
    "fly": (
        (
            "a lost command stops the servos in the middle",
            "form",
            """
    record = {"states": [start], "commands": [], "frames": []}
    held, view, k = np.zeros(4), None, 0
    while k < steps:
        if not k % IMAGE_EVERY:
            view = look(record["states"][-1])
            record["frames"].append(view)
        sent = carry(decide(record["states"][-1], view))
        sent = np.zeros(4) if sent is None else sent
        record["states"].append(step(record["states"][-1], held, sent))
        record["commands"].append(sent)
        held, k = sent, k + 1
        if record["states"][-1][2] <= floor:
            break
    record["states"], record["commands"] = map(np.array, (record["states"], record["commands"]))
    return record
""",
        ),
        (
            "a new picture in every step",
            "form",
            """
    record = {"states": [start], "commands": [], "frames": []}
    held, k = np.zeros(4), 0
    while k < steps:
        view = look(record["states"][-1])
        record["frames"].append(view)
        sent = carry(decide(record["states"][-1], view))
        sent = held if sent is None else sent
        record["states"].append(step(record["states"][-1], held, sent))
        record["commands"].append(sent)
        held, k = sent, k + 1
        if record["states"][-1][2] <= floor:
            break
    record["states"], record["commands"] = map(np.array, (record["states"], record["commands"]))
    return record
""",
        ),
    ),
    "landing_score": (
        (
            "the last state is taken for the touch",
            "form",
            """
    end = states[-1]
    if end[2] > FLOOR_Z:
        return 0.0, 0.0, 0.0, 0.0
    x, sink, off = end[0], -end[8], abs(end[1] - (PAD[2] + PAD[3]) / 2)
    if not (PAD[0] <= x <= PAD[1] and PAD[2] <= end[1] <= PAD[3]):
        return float(x), float(off), float(sink), 0.0
    points = 100 * np.exp(-(off**2) / WORTH_M**2) * min(1, SOFT_SINK / sink)
    return float(x), float(off), float(sink), float(points)
""",
        ),
        (
            "points fall in a straight line with the offset",
            "form",
            """
    a, b = states[-2:]
    if b[2] > FLOOR_Z:
        return 0.0, 0.0, 0.0, 0.0
    at = a + (b - a) * (a[2] - FLOOR_Z) / (a[2] - b[2])
    x, y, sink = at[0], at[1], -at[8]
    off = abs(y - (PAD[2] + PAD[3]) / 2)
    if not (PAD[0] <= x <= PAD[1] and PAD[2] <= y <= PAD[3]):
        return float(x), float(off), float(sink), 0.0
    points = 100 * max(0.0, 1 - off / WORTH_M) * min(1, SOFT_SINK / sink)
    return float(x), float(off), float(sink), float(points)
""",
        ),
    ),
}
