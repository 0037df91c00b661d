"""Lab 10: wrong solutions that students write.

Each must lose points and be seen by a public check.
"""

MUTANTS = {
    "encode_ppm": (
        (
            "throttle not mapped to -1..1",
            'positions["T"] = 2.0 * max(positions["T"], 0.0) - 1.0',
            "pass",
        ),
        ("slots in the order of the sticks", "for letter in order", 'for letter in "TAER"'),
        ("sticks not cut", "float(np.clip(sticks[name], -1.0, 1.0))", "float(sticks[name])"),
        ("ticks are taken for microseconds", "start_tick + TICKS_PER_US * np", "start_tick + np"),
        ("no wrap", ".astype(int) % TIMER", ".astype(int)"),
        (
            "decimals cut off, not rounded",
            "round(CENTRE_US + REACH_US * positions[letter])",
            "int(CENTRE_US + REACH_US * positions[letter])",
        ),
        ("pulse width in ticks", "down + TICKS_PER_US * int(GAP_US)", "down + int(GAP_US)"),
        ("sign of the sticks", "CENTRE_US + REACH_US", "CENTRE_US - REACH_US"),
        (
            "numbers that are none pass",
            "if not all(np.isfinite(sticks[name]) for name in STICKS):",
            "if False:",
        ),
        ("middle of every radio is 1500", "round(CENTRE_US + ", "round(1500.0 + "),
        (
            "the pulse is added to the slot",
            "np.cumsum(slots_us)",
            "np.cumsum(np.array(slots_us) + int(GAP_US))",
        ),
    ),
    "decode_ppm": (
        ("no wrap of differences", "(np.diff(ticks) % TIMER)", "np.diff(ticks)"),
        ("ticks are taken for microseconds", "% TIMER) / TICKS_PER_US", "% TIMER)"),
        ("half microseconds lost", "/ TICKS_PER_US", "// TICKS_PER_US"),
        ("off by one at the start of a frame", "pauses[i] + 1 :", "pauses[i] :"),
        (
            "number of slots not checked",
            "len(slots) == channels and ",
            "len(slots) >= channels and ",
        ),
        ("slots not checked", "np.all((slots >= VALID_US[0]) & (slots <= VALID_US[1]))", "True"),
        ("any slot in place of all", "np.all(", "np.any("),
        ("lower limit forgotten", "(slots >= VALID_US[0]) & ", ""),
        ("pause must be longer than the limit", ">= PAUSE_US", "> PAUSE_US"),
        ("only the last frame", "np.array(frames).reshape", "np.array(frames[-1:]).reshape"),
    ),
    "failsafe_state": (
        ("engages without letting go first", 'state == "SAFE" and armed', 'state == "SAFE"'),
        ("one frame too late", "good >= ENGAGE_FRAMES", "good > ENGAGE_FRAMES"),
        ("a gap does not restart the count", "        good = 0\n", "        pass\n"),
        ("age is never set back", "0.0 if valid else memory", "memory"),
        (
            "LOST comes back by itself",
            'elif valid and state == "HOLD"',
            'elif valid and state in ("HOLD", "LOST")',
        ),
        (
            "pilot moves, the host may ask again at once",
            'state, armed, good = "SAFE", False, 0',
            'state, armed, good = "SAFE", True, 0',
        ),
        (
            "pilot overruled by a host that engages",
            "if pilot_moved:",
            "if pilot_moved and not (valid and engage):",
        ),
        ("limit must be passed, not reached", "age_ms >= LOST_MS", "age_ms > LOST_MS"),
        ("HOLD for ever", 'state in ("ACTIVE", "HOLD") and', 'state == "ACTIVE" and'),
        (
            "engage off is obeyed without a valid command",
            "elif valid and not engage",
            "elif not engage",
        ),
        ("steps counted in place of time", 'memory["age_ms"] + dt_ms', 'memory["age_ms"] + 22.0'),
    ),
    "ssim_monitor": (
        ("8-bit arithmetic", "images.astype(float)", "images"),
        ("sample variance", "blocks.var(axis=(2, 4))", "blocks.var(axis=(2, 4), ddof=1)"),
        ("standard deviation for variance", "blocks.var(axis=(2, 4))", "blocks.std(axis=(2, 4))"),
        ("factor 2 forgotten", "2.0 * covariance + C2", "covariance + C2"),
        ("constants mixed up", "2.0 * covariance + C2", "2.0 * covariance + C1"),
        (
            "blocks cut the wrong way",
            "height // BLOCK_PX, BLOCK_PX, width // BLOCK_PX, BLOCK_PX",
            "height // BLOCK_PX, width // BLOCK_PX, BLOCK_PX, BLOCK_PX",
        ),
        (
            "alarm one pair late",
            "last = slice(i - count + 1, i + 1)",
            "last = slice(max(i - count, 0), i + 1)",
        ),
        (
            "any bad pair raises the alarm",
            "np.all(ssim[last] < threshold)",
            "np.any(ssim[last] < threshold)",
        ),
        (
            "ups and downs cancel",
            "np.abs(np.diff(grey, axis=0)).mean(axis=(1, 2))",
            "np.abs(np.diff(grey, axis=0).mean(axis=(1, 2)))",
        ),
        ("threshold written in", "ssim[last] < threshold", "ssim[last] < 0.7"),
        ("frozen by similarity", "difference[last] < FROZEN_LEVELS", "ssim[last] > 0.98"),
    ),
}
