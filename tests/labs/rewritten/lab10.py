"""Lab 10, rewritten with a wrong idea: of each exercise the idea, its kind, the function's body."""

REWRITTEN = {
    "encode_ppm": (
        (
            "the gap comes on top of each slot",
            "form",
            """
    usable = all(np.isfinite(sticks[name]) for name in STICKS)
    value = {n[0].upper(): (np.clip(sticks[n], -1, 1) if usable else 0.0) for n in STICKS}
    value["T"] = 2 * max(value["T"], 0) - 1
    ticks, now = [], start_tick
    for letter in order:
        ticks += [now, now + int(GAP_US) * TICKS_PER_US]
        now += (round(CENTRE_US + REACH_US * value[letter]) + int(GAP_US)) * TICKS_PER_US
    ticks += [now, now + int(GAP_US) * TICKS_PER_US]
    return np.array(ticks).astype(int) % TIMER
""",
        ),
        (
            "the throttle is sent as the other sticks are",
            "form",
            """
    usable = all(np.isfinite(sticks[name]) for name in STICKS)
    value = {n[0].upper(): (np.clip(sticks[n], -1, 1) if usable else 0.0) for n in STICKS}
    ticks, now = [], start_tick
    for letter in order:
        ticks += [now, now + int(GAP_US) * TICKS_PER_US]
        now += round(CENTRE_US + REACH_US * value[letter]) * TICKS_PER_US
    ticks += [now, now + int(GAP_US) * TICKS_PER_US]
    return np.array(ticks).astype(int) % TIMER
""",
        ),
    ),
    "decode_ppm": (
        (
            "the last frame needs no pause after it",
            "form",
            """
    slots, frames, inside = [], [], False
    for before, after in zip(ticks[:-1], ticks[1:]):
        gap = ((after - before) % TIMER) / TICKS_PER_US
        if gap >= PAUSE_US:
            slots, inside = [], True
        elif inside:
            slots.append(gap)
            good = all(VALID_US[0] <= slot <= VALID_US[1] for slot in slots)
            if len(slots) == channels and good:
                frames.append(slots)
                slots, inside = [], False
    return np.array(frames, dtype=float).reshape(-1, channels)
""",
        ),
        (
            "the timer never starts again",
            "form",
            """
    slots, frames, inside = [], [], False
    for before, after in zip(ticks[:-1], ticks[1:]):
        gap = (after - before) / TICKS_PER_US
        if gap >= PAUSE_US:
            good = all(VALID_US[0] <= slot <= VALID_US[1] for slot in slots)
            if inside and len(slots) == channels and good:
                frames.append(slots)
            slots, inside = [], True
        else:
            slots.append(gap)
    return np.array(frames, dtype=float).reshape(-1, channels)
""",
        ),
    ),
    "matches": (
        (
            "without a pilot any command will do if the throttle is idle",
            "form",
            """
    if pilot_us is None:
        return abs(command_us[0] - SAFE_US[0]) <= IDLE_US
    return max(abs(a - b) for a, b in zip(command_us, pilot_us)) <= NEAR_US
""",
        ),
        (
            "the mean of the differences decides",
            "form",
            """
    if pilot_us is None:
        limits = [IDLE_US] + 3 * [NEAR_US]
        return not any(abs(a - b) > m for a, b, m in zip(command_us, SAFE_US, limits))
    return bool(np.mean(np.abs(np.subtract(command_us, pilot_us))) <= NEAR_US)
""",
        ),
    ),
    "failsafe_state": (
        (
            "a lost computer takes over again as soon as it is back",
            "form",
            """
    new = {**memory, "age_ms": memory["age_ms"] + dt_ms, "edge_ms": memory["edge_ms"] + dt_ms}
    active = new["state"] == "ACTIVE"
    if active and pilot_us is not None:
        before = new["pilot_us"] or pilot_us
        new["pilot_us"] = before
        if any(abs(a - b) > MOVED_US for a, b in zip(pilot_us, before)):
            new["state"] = "SAFE"
    if new["age_ms"] >= LOST_MS:
        new["good"] = 0
        new["state"] = "LOST" if new["state"] == "ACTIVE" else new["state"]
    if command_us is None:
        return new
    new["age_ms"], new["engage"] = 0.0, engage
    if not engage:
        return {**new, "state": "SAFE", "good": 0}
    if new["state"] == "LOST":
        return {**new, "state": "ACTIVE", "pilot_us": pilot_us}
    if new["state"] == "SAFE":
        if not memory["engage"]:
            new["good"], new["edge_ms"] = 1, 0.0
        elif new["good"]:
            new["good"] = new["good"] + 1 if new["edge_ms"] < WINDOW_MS else 0
        new["good"] = new["good"] if matches(command_us, pilot_us) else 0
        if new["good"] >= ENGAGE_FRAMES:
            new = {**new, "state": "ACTIVE", "good": 0, "pilot_us": pilot_us}
    return new
""",
        ),
        (
            "counts good frames without a fresh press of the switch",
            "form",
            """
    new = {**memory, "age_ms": memory["age_ms"] + dt_ms, "edge_ms": memory["edge_ms"] + dt_ms}
    if new["state"] == "ACTIVE" and pilot_us is not None:
        before = new["pilot_us"] or pilot_us
        new["pilot_us"] = before
        if any(abs(a - b) > MOVED_US for a, b in zip(pilot_us, before)):
            new["state"] = "SAFE"
    if new["age_ms"] >= LOST_MS:
        new["good"] = 0
        new["state"] = "LOST" if new["state"] == "ACTIVE" else new["state"]
    if command_us is None:
        return new
    new["age_ms"], new["engage"] = 0.0, engage
    if not engage:
        return {**new, "state": "SAFE", "good": 0}
    if new["state"] == "SAFE":
        new["good"] = new["good"] + 1 if matches(command_us, pilot_us) else 0
        if new["good"] >= ENGAGE_FRAMES:
            new = {**new, "state": "ACTIVE", "good": 0, "pilot_us": pilot_us}
    return new
""",
        ),
    ),
    "ssim_monitor": (
        (
            "one block as large as the picture",
            "form",
            """
    grey = images.astype(float).reshape(len(images), -1)
    ssim, change = [], []
    for a, b in zip(grey[:-1], grey[1:]):
        cov = np.mean(a * b) - a.mean() * b.mean()
        light = (2 * a.mean() * b.mean() + C1) / (a.mean() ** 2 + b.mean() ** 2 + C1)
        ssim.append(light * (2 * cov + C2) / (a.var() + b.var() + C2))
        change.append(np.abs(a - b).mean())
    ssim, change, alarm = np.array(ssim), np.array(change), np.zeros(len(ssim), int)
    for i in range(count - 1, len(ssim)):
        if max(ssim[i - count + 1 : i + 1]) < threshold:
            alarm[i] = 1
        elif max(change[i - count + 1 : i + 1]) < FROZEN_LEVELS:
            alarm[i] = 2
    return ssim, alarm
""",
        ),
        (
            "the alarm does not wait for several pictures",
            "form",
            """
    n, h, w = images.shape
    tiles = images.astype(float).reshape(n, h // BLOCK_PX, BLOCK_PX, w // BLOCK_PX, BLOCK_PX)
    a, b = tiles[:-1], tiles[1:]
    ma, mb, va, vb = (f(axis=(2, 4)) for f in (a.mean, b.mean, a.var, b.var))
    cov = (a * b).mean(axis=(2, 4)) - ma * mb
    per_tile = (2 * ma * mb + C1) * (2 * cov + C2) / (ma**2 + mb**2 + C1) / (va + vb + C2)
    ssim = per_tile.mean(axis=(1, 2))
    change = np.abs(a - b).mean(axis=(1, 2, 3, 4))
    return ssim, np.where(ssim < threshold, 1, np.where(change < FROZEN_LEVELS, 2, 0))
""",
        ),
    ),
}
