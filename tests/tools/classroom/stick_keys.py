"""Keys -> sticks as page/sticks.js has it, for scripted pilots; test_sticks.py compares both."""

from collections.abc import Mapping

SURFACES = ("aileron", "elevator", "rudder")
KEY_RATE, SPRING_RATE, THROTTLE_RATE = 2.0, 4.0, 0.5  # [1/s]
LONGEST_STEP_S = 0.1


def shape(value: float, dead_band: float = 0.0, expo: float = 0.0, reverse: bool = False) -> float:
    """Travel -1..1 -> output -1..1: dead band d, then (1 - e) x + e x^3, then the sign."""
    travel = min(max(value, -1.0), 1.0)
    beyond = max((abs(travel) - dead_band) / (1.0 - dead_band), 0.0)
    size = (1.0 - expo) * beyond + expo * beyond**3
    return size if (travel > 0.0) != reverse else -size


def key_step(sticks: Mapping[str, float], keys: Mapping[str, int], dt: float) -> dict[str, float]:
    """Sticks after dt [s] with keys -1, 0 or 1 for each stick."""
    step = min(max(dt, 0.0), LONGEST_STEP_S)
    throttle = sticks["throttle"] + keys.get("throttle", 0) * THROTTLE_RATE * step
    new = {"throttle": min(max(throttle, 0.0), 1.0)}
    for name in SURFACES:
        value, key = sticks[name], keys.get(name, 0)
        if key == 0 or key * value < 0.0:
            size = max(abs(value) - SPRING_RATE * step, 0.0)
            new[name] = size if value > 0.0 else -size
        else:
            new[name] = min(max(value + key * KEY_RATE * step, -1.0), 1.0)
    return new
