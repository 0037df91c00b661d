"""Writes data/flights.npz: pictures of flights of the kit's expert, for lab 13's policy.

SIMULATED. Run from the kit's folder, with the solution's functions of lab.py; takes a minute:

    python labs/lab13_fly_your_own/make_data.py
"""

import sys
from pathlib import Path

import numpy as np

from falconwing_kit.tools.grading import load_parts

FOLDER = Path(__file__).parent
sys.path.insert(0, str(FOLDER))
import given  # noqa: E402

FLIGHTS = 5


def main() -> None:
    """Fly with noise on the bank, look at every second step, keep what the expert wanted."""
    parts, space = load_parts("kit"), {"np": np, "given": given}
    text = (FOLDER / "lab.py").read_text(encoding="utf-8")
    for name in ("merge_gaussians", "thin_hall"):
        exec(text[text.index(f"def {name}(") :].split("\n# %%")[0], space)
    look = given.new_look(parts, space["thin_hall"](parts))
    step, rng = given.new_plant(parts), np.random.default_rng(0)
    images, banks, labels, starts = [], [], [], []
    for number in range(FLIGHTS):
        expert, last, noise = given.Expert(parts), np.zeros(4), 0.0
        state = given.START + rng.normal(size=9) * [0.5, 0.3, 0.1, 0.01, 0.02, 0.02, 0.2, 0.2, 0.1]
        starts.append(len(images))
        for k in range(given.STEPS):
            own = expert.bank(state)
            noise = 0.9 * noise + (0.06 * rng.normal() if number else 0.0)
            bank = float(np.clip(own + noise, -given.BANK_LIMIT, given.BANK_LIMIT))
            if k % given.IMAGE_EVERY == 0:
                images.append(given.small(look(state)))
                labels.append(own / given.POLICY_BANK)
            banks.append(bank / given.POLICY_BANK)
            command = expert.command(state, bank)
            state, last = step(state, last, command), command
            if state[2] <= given.FLOOR_Z:
                break
        if len(banks) % 2:
            banks.append(banks[-1])
        print(number, k, np.round(state[:3], 2))
    (FOLDER / "data").mkdir(exist_ok=True)
    np.savez_compressed(
        FOLDER / "data" / "flights.npz",
        images=np.array(images, np.uint8),
        banks=np.array(banks, np.float32),
        labels=np.array(labels, np.float32),
        starts=np.array(starts),
    )


if __name__ == "__main__":
    main()
