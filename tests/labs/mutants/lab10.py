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
    "matches": (
        ("signed difference", "all(abs(a - b) <= NEAR_US", "all(a - b <= NEAR_US"),
        ("the limit itself does not match", "abs(a - b) <= NEAR_US", "abs(a - b) < NEAR_US"),
        ("any slot in place of all", "all(abs(a - b) <= NEAR_US", "any(abs(a - b) <= NEAR_US"),
        (
            "only the throttle",
            "zip(command_us, pilot_us, strict=True))",
            "[(command_us[0], pilot_us[0])])",
        ),
        ("idle matches against any pilot", "if pilot_us is not None:", "if False:"),
        ("throttle as wide as the others", "(IDLE_US, NEAR_US,", "(NEAR_US, NEAR_US,"),
        ("all as narrow as the throttle", "(IDLE_US, NEAR_US, NEAR_US, NEAR_US)", "(IDLE_US,) * 4"),
    ),
    "failsafe_state": (
        ("engages without letting go first", 'if not memory["engage"]:', 'if new["good"] == 0:'),
        ("one command too late", ">= ENGAGE_FRAMES", "> ENGAGE_FRAMES"),
        ("engages on anything", "if not matches(command_us, pilot_us):", "if False:"),
        (
            "only the last command must match",
            '        if not matches(command_us, pilot_us):\n            new["good"] = 0\n'
            '        if new["good"] >= ENGAGE_FRAMES:',
            '        if new["good"] >= ENGAGE_FRAMES and matches(command_us, pilot_us):',
        ),
        (
            "matches in flight too",
            'elif new["state"] == "SAFE":\n        if not memory',
            'elif not matches(command_us, pilot_us):\n        new["state"] = "SAFE"\n'
            '    elif new["state"] == "SAFE":\n        if not memory',
        ),
        ("no window", '+ 1 if new["edge_ms"] < WINDOW_MS else 0', "+ 1"),
        ("window's limit counts", 'new["edge_ms"] < WINDOW_MS', 'new["edge_ms"] <= WINDOW_MS'),
        ("silence does not end the count", 'LOST_MS:\n        new["good"] = 0\n', "LOST_MS:\n"),
        ("age is never set back", '{**new, "age_ms": 0.0, "engage"', '{**new, "engage"'),
        (
            "LOST comes back by itself",
            '    elif new["state"] == "SAFE":',
            '    elif new["state"] == "LOST":\n        new["state"] = "ACTIVE"\n'
            '    elif new["state"] == "SAFE":',
        ),
        ("limit must be passed, not reached", '"age_ms"] >= LOST_MS', '"age_ms"] > LOST_MS'),
        (
            "pilot ignored",
            '> MOVED_US:\n            new["state"] = "SAFE"',
            "> MOVED_US:\n            pass",
        ),
        ("pilot may move one way", "max(abs(a - b)", "max((a - b)"),
        ("pilot's limit included", "> MOVED_US", ">= MOVED_US"),
        (
            "only fast movements",
            'if new["pilot_us"] is None:\n            new["pilot_us"] = pilot_us\n'
            "        if max(abs(a - b) for a, b in "
            'zip(pilot_us, new["pilot_us"], strict=True)) > MOVED_US:\n'
            '            new["state"] = "SAFE"',
            'if new["pilot_us"] is None:\n            new["pilot_us"] = pilot_us\n'
            "        if max(abs(a - b) for a, b in "
            'zip(pilot_us, new["pilot_us"], strict=True)) > MOVED_US:\n'
            '            new["state"] = "SAFE"\n        new["pilot_us"] = pilot_us',
        ),
        (
            "pilot moves, the host may ask again at once",
            '> MOVED_US:\n            new["state"] = "SAFE"',
            '> MOVED_US:\n            new["state"], memory = "SAFE", {**memory, "engage": False}',
        ),
        (
            "sticks of the engagement before",
            'new["good"], new["pilot_us"] = "ACTIVE", 0, pilot_us',
            'new["good"] = "ACTIVE", 0',
        ),
        (
            "engage off is obeyed without a command",
            "    if command_us is None:\n        return new\n    if not engage:",
            '    if not engage:\n        new["state"], new["good"] = "SAFE", 0\n'
            "    if command_us is None:\n"
            "        return new\n    if not engage:",
        ),
        (
            "steps counted in place of time",
            'age_ms=memory["age_ms"] + dt_ms',
            'age_ms=memory["age_ms"] + 22.0',
        ),
    ),
    "TrainerBridge": (
        ("checksum not compared", 'crc16(payload) != int.from_bytes(sent, "little")', "False"),
        (
            "checksum's high byte first",
            'int.from_bytes(sent, "little")',
            'int.from_bytes(sent, "big")',
        ),
        ("checksum of the whole frame", "crc16(payload) !=", "crc16(content) !="),
        ("rest of a piece forgotten", "self._part = part[: MAX_FRAME + 1]", 'self._part = b""'),
        ("only the first frame of a piece", "for frame in frames:", "for frame in frames[:1]:"),
        ("zeros not put back", 'b"\\0".join(pieces)', 'b"".join(pieces)'),
        (
            "a zero behind the last piece too",
            'content = b"\\0".join(pieces)',
            'content = b"".join(piece + b"\\0" for piece in pieces)',
        ),
        ("any type is a command", "payload[0] == COMMAND and ", ""),
        ("longer payloads are taken", "len(payload) == 12", "len(payload) >= 12"),
        (
            "slots' high byte first",
            "payload[i] + 256 * payload[i + 1]",
            "256 * payload[i] + payload[i + 1]",
        ),
        ("all flags are engage", "bool(payload[3] & 1)", "bool(payload[3])"),
        (
            "range not checked",
            "if not all(RANGE_US[0] <= us <= RANGE_US[1] for us in slots):",
            "if False:",
        ),
        (
            "range of the radio in place of the commands'",
            "RANGE_US[0] <= us <= RANGE_US[1]",
            "LIMITS_US[0] <= us <= LIMITS_US[1]",
        ),
        (
            "a command out of range sets the sequence",
            "for us in slots):\n            return",
            "for us in slots):\n            self._sequence = sequence\n            return",
        ),
        (
            "a command out of range keeps the host alive",
            "for us in slots):\n            return",
            "for us in slots):\n            self._memory = {**self._memory, 'age_ms': 0.0}\n"
            "            return",
        ),
        (
            "sequence not checked",
            "if self._sequence is not None and not 1",
            "if False and self._sequence is not None and not 1",
        ),
        (
            "sequence does not wrap",
            "(sequence - self._sequence) % 65536",
            "sequence - self._sequence",
        ),
        ("the same sequence is new", "and not 1 <= (sequence", "and not 0 <= (sequence"),
        ("old sequences are new", "% 65536 <= 32767", "% 65536 <= 65535"),
        ("only the next sequence is new", "% 65536 <= 32767", "% 65536 <= 1"),
        ("no limit of speed", "np.clip(cut, low, high)", "cut"),
        ("slots not cut", "np.clip(self._command, *LIMITS_US)", "np.array(self._command)"),
        (
            "SAFE is approached slowly",
            '!= "ACTIVE":\n            self._slots = SAFE_US',
            '!= "ACTIVE":\n            old = np.array(self._slots)\n'
            "            near = np.clip(SAFE_US, old - SLEW_US, old + SLEW_US)\n"
            "            self._slots = tuple(float(us) for us in near)",
        ),
        (
            "the command is sent in every state",
            'if self.state != "ACTIVE":',
            'if self.state == "LOST":',
        ),
        ("a frame is no step", "self._step(t_ms, None, False)", "pass"),
        ("every step is 22 ms", "t_ms - self._t_ms, t_ms", "22.0, t_ms"),
        ("time since the start for each step", "t_ms - self._t_ms, t_ms", "t_ms, t_ms"),
        ("pilot's sticks not passed on", "engage, self._pilot)", "engage, None)"),
        (
            "pilot's sticks kept when no longer measured",
            "self._pilot = pilot_us",
            "self._pilot = pilot_us or self._pilot",
        ),
        (
            "slots chosen before the pilot is asked",
            "self._step(t_ms, None, False)\n        if self.state",
            "before = self.state\n        self._step(t_ms, None, False)\n        if before",
        ),
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
