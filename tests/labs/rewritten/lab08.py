"""Lab 8, rewritten with a wrong idea: of each exercise the idea, its kind, the function's body."""

REWRITTEN = {
    "history_window": (
        (
            "runs through from one flight into the next",
            "form",
            """
    padded = np.concatenate([np.zeros(k), commands])
    return np.array([padded[i : i + k][::-1] for i in range(len(commands))])
""",
        ),
        (
            "the oldest command first",
            "form",
            """
    rows = []
    for first, last in zip(starts, [*starts[1:], len(commands)]):
        flown = np.concatenate([np.zeros(k), commands[first:last]])
        rows += [flown[i : i + k] for i in range(last - first)]
    return np.array(rows)
""",
        ),
        (
            "the command that is to be learnt stands in its own history",
            "form",
            """
    rows = []
    for first, last in zip(starts, [*starts[1:], len(commands)]):
        flown = np.concatenate([np.zeros(k), commands[first:last]])
        rows += [flown[i + 1 : i + k + 1][::-1] for i in range(last - first)]
    return np.array(rows)
""",
        ),
    ),
    "make_dataset": (
        (
            "the mirror turns the picture upside down",
            "form",
            """
    x = np.moveaxis(images, -1, 1).astype(np.float32) / 127.5 - 1
    if mirror:
        x = np.vstack([x, np.flip(x, axis=2)])
        history, labels = np.vstack([history, -history]), np.hstack([labels, -labels])
    return x, history, labels
""",
        ),
        (
            "levels from 0 to 1",
            "form",
            """
    x = np.moveaxis(images, -1, 1).astype(np.float32) / 255
    if mirror:
        x = np.vstack([x, np.flip(x, axis=3)])
        history, labels = np.vstack([history, -history]), np.hstack([labels, -labels])
    return x, history, labels
""",
        ),
    ),
    "bc_loss_step": (
        (
            "the mean over the weights' sum, a weighted average",
            "form",
            """
    optimiser.zero_grad()
    weight = 1 + TURN_WEIGHT * torch.abs(labels)
    miss = (network(images, history) - labels).pow(2)
    loss = (weight * miss).sum() / weight.sum()
    loss.backward()
    torch.nn.utils.clip_grad_norm_(network.parameters(), CLIP_NORM)
    optimiser.step()
    return float(loss)
""",
        ),
        (
            "every gradient is clipped for itself",
            "form",
            """
    optimiser.zero_grad()
    weight = 1 + TURN_WEIGHT * torch.abs(labels)
    loss = torch.mean(weight * (network(images, history) - labels).pow(2))
    loss.backward()
    torch.nn.utils.clip_grad_value_(network.parameters(), CLIP_NORM)
    optimiser.step()
    return float(loss)
""",
        ),
    ),
    "closed_loop_eval": (
        (
            "the history keeps what the policy wished, before the limit",
            "form",
            """
    offsets, landed = [], []
    for start in starts:
        flight, past = begin(start), [0.0] * k
        while not flight.over:
            wish = float(policy(flight.look(), np.array(past)))
            flight.fly(min(max(wish, -1.0), 1.0))
            past = [wish, *past][:k]
        offsets.append(flight.offset)
        landed.append(abs(flight.offset) <= PAD_HALF and not flight.lost)
    offsets, landed = np.array(offsets), np.array(landed)
    ald = float(np.mean(np.abs(offsets[landed]))) if any(landed) else float("nan")
    return {"offsets": offsets, "landed": landed, "success": float(np.mean(landed)), "ald": ald}
""",
        ),
        (
            "the mean distance over all flights, missed ones too",
            "form",
            """
    offsets, landed = [], []
    for start in starts:
        flight, past = begin(start), [0.0] * k
        while not flight.over:
            wish = min(max(float(policy(flight.look(), np.array(past))), -1.0), 1.0)
            flight.fly(wish)
            past = [wish, *past][:k]
        offsets.append(flight.offset)
        landed.append(abs(flight.offset) <= PAD_HALF and not flight.lost)
    offsets, landed = np.array(offsets), np.array(landed)
    success, ald = float(np.mean(landed)), float(np.mean(np.abs(offsets)))
    return {"offsets": offsets, "landed": landed, "success": success, "ald": ald}
""",
        ),
        (
            "the history of one flight is kept for the next",
            "form",
            """
    offsets, landed, past = [], [], [0.0] * k
    for start in starts:
        flight = begin(start)
        while not flight.over:
            wish = min(max(float(policy(flight.look(), np.array(past))), -1.0), 1.0)
            flight.fly(wish)
            past = [wish, *past][:k]
        offsets.append(flight.offset)
        landed.append(abs(flight.offset) <= PAD_HALF and not flight.lost)
    offsets, landed = np.array(offsets), np.array(landed)
    ald = float(np.mean(np.abs(offsets[landed]))) if any(landed) else float("nan")
    return {"offsets": offsets, "landed": landed, "success": float(np.mean(landed)), "ald": ald}
""",
        ),
    ),
}
