"""Make lab 5's logs again: the kit's own aircraft flies straight passes through the hall.

Simulated, not measured.

    python labs/lab05_identification/make_data.py

The truth is integrated by the kit in steps of 10 ms, three-dimensional; the lab's plane model
does not include it.
"""

import json
from pathlib import Path

import numpy as np

from falconwing_kit.aircraft import Model, paper_model, roll_out, trim

HERE = Path(__file__).parent
TRUTH = {
    "cL_0": 0.083,
    "cL_alpha": 1.47,
    "cD_0": 0.0185,
    "cD_induced": 0.22,
    "kT": 9.6,
    "M_0": 0.112,
    "M_de": 0.33,
    "M_alpha": -1.12,
}
DELAY, FINE, PER_ROW = 0.06, 0.01, 5  # s; s of an integration step; steps a row
PASSES, ROWS = 16, 86
SIGMA = np.array([0.03, 0.03, np.radians(0.6)])  # m, m, rad


def main() -> None:
    """Write data/passes.npz and data/truth.json."""
    rng = np.random.default_rng(2025)
    model = paper_model().with_values(TRUTH)
    flights = [fly_pass(model, rng, speed) for speed in np.tile([6.0, 6.7, 7.4, 8.2], PASSES // 4)]
    poses, sticks = (np.stack(part) for part in zip(*flights, strict=True))
    poses += SIGMA * rng.normal(size=poses.shape)
    bad = rng.random(poses.shape[:2])
    poses[bad < 0.02] += np.array([3.0, 1.5, 0.6]) * rng.normal(size=(int((bad < 0.02).sum()), 3))
    poses[bad > 0.97] = np.nan
    poses[3, 30:36] = np.nan  # a burst of analog noise
    (HERE / "data").mkdir(exist_ok=True)
    np.savez_compressed(
        HERE / "data" / "passes.npz", poses=np.round(poses, 5), sticks=np.round(sticks, 4)
    )
    text = json.dumps({"K": TRUTH, "delay": DELAY, "simulated": True}, indent=1)
    (HERE / "data" / "truth.json").write_text(text + "\n", encoding="utf-8")


def fly_pass(model: Model, rng: np.random.Generator, speed: float) -> tuple[np.ndarray, np.ndarray]:
    """One pass: true px, pz, pitch (ROWS, 3) and the logged throttle and elevator (ROWS, 2).

    The pilot holds height and speed and shakes both sticks, so that every coefficient shows.
    """
    steady = trim(model, speed)
    state, late = steady.state.copy(), round(DELAY / FINE)
    state[0], state[2] = -17.0, rng.uniform(1.8, 2.6)
    frequency, phase = rng.uniform(1.5, 8.0, (4, 2)), rng.uniform(0.0, 2.0 * np.pi, (4, 2))
    waiting = [steady.command] * (late + 1)
    poses, sticks = np.empty((ROWS, 3)), np.empty((ROWS, 2))
    for k in range(ROWS):
        shake = np.sin(frequency * k * FINE * PER_ROW + phase).sum(axis=0)
        command = steady.command.copy()
        command[0] += 0.16 * shake[0] + 0.2 * (speed - np.hypot(state[6], state[8]))
        command[2] += (
            0.13 * shake[1]
            + 0.5 * (steady.state[3] - state[3])
            + 0.05 * (2.2 - state[2])
            - 0.1 * state[8]
        )
        command = np.clip(command, [0.0, -1.0, -1.0, -1.0], 1.0)
        poses[k], sticks[k] = state[[0, 2, 3]], command[[0, 2]]
        for _ in range(PER_ROW):
            waiting = [*waiting[1:], command]
            state = roll_out(model, state, waiting[0][None], FINE)[-1]
    return poses, sticks


if __name__ == "__main__":
    main()
