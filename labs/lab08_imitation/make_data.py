"""Make the lab's data: a coarse copy of the arena, and SIMULATED flights of the expert in it.

python labs/lab08_imitation/make_data.py
"""

from pathlib import Path

import numpy as np
from given import STEP_S, Flight, camera_view, expert
from scipy.spatial.transform import Rotation

from falconwing_kit.scene import GaussianScene, load_scene, write_quantised

DATA = Path(__file__).parent / "data"
CELL, PAD_CELL = 0.7, 0.25  # side of the cells whose Gaussians become one [m]
LEVELS = 16  # steps between the grey levels that are kept, so that the file stays small
FLIGHTS = {
    "clean": (8, 1, 0.0),
    "noisy": (8, 1, 0.6),
    "held_out": (4, 2, 0.0),
}  # how many, seed of the starts, shake


def coarse(scene: GaussianScene) -> GaussianScene:
    """A scene without its leader, with similar Gaussians of each cell merged by their moments."""
    scene = scene.selected(~scene.labelled("leader"))
    rotations = Rotation.from_quat(scene.quaternions[:, [1, 2, 3, 0]]).as_matrix()
    facing = np.abs(rotations[np.arange(len(scene)), :, scene.scales.argmin(axis=1)]).argmax(axis=1)
    side = np.where(scene.labelled("pad"), PAD_CELL, CELL)[:, None]
    keys = np.column_stack([np.floor(scene.means / side), facing, scene.labels]).astype(int)
    _, cell = np.unique(keys, axis=0, return_inverse=True)
    cell, cells = cell.ravel(), int(cell.max()) + 1
    area = np.prod(np.sort(scene.scales, axis=1)[:, 1:], axis=1, dtype=float)

    def mean(values: np.ndarray) -> np.ndarray:
        flat = values.reshape(len(values), -1)
        sums = [np.bincount(cell, area * column, cells) for column in flat.T]
        return np.array(sums).T.reshape(cells, *values.shape[1:]) / total.reshape(
            cells, *[1] * (values.ndim - 1)
        )

    total = np.bincount(cell, area, cells)
    means = mean(scene.means)
    spread, away = rotations * scene.scales[:, None, :], scene.means - means[cell]
    variances, axes = np.linalg.eigh(
        mean(spread @ spread.transpose(0, 2, 1) + away[:, :, None] * away[:, None, :])
    )
    axes[:, :, 0] *= np.sign(np.linalg.det(axes))[:, None]
    quaternions = Rotation.from_matrix(axes).as_quat()[:, [3, 0, 1, 2]]
    labels = np.zeros(cells, np.uint8)
    labels[cell] = scene.labels
    scales, opacities = np.sqrt(np.maximum(variances, 1e-6)), np.full(cells, 0.99)
    fields = (
        means,
        quaternions,
        scales,
        opacities,
        mean(scene.sh[:, :1]),
        labels,
        scene.label_names,
    )
    return GaussianScene(*fields, source="coarse copy of the kit's arena")


def fly(scene: GaussianScene, flights: int, seed: int, shake: float) -> dict[str, np.ndarray]:
    """Flights of the expert; `shake` is the size of slow noise on its command [full ailerons]."""
    look, rng = camera_view(scene), np.random.default_rng(seed)
    starts = np.column_stack([rng.uniform(-0.6, 0.6, flights), rng.uniform(-0.08, 0.08, flights)])
    log: dict[str, list] = {name: [] for name in ("images", "flown", "expert", "offset", "starts")}
    for offset, yaw in starts:
        flight, noise = Flight(offset, yaw, 0.0, -1, look), 0.0
        log["starts"].append(len(log["flown"]))
        while not flight.over:
            noise = 0.8 * noise + 0.6 * shake * rng.normal()
            log["images"].append(flight.look() // LEVELS * LEVELS + LEVELS // 2)
            log["offset"].append(flight.offset)
            log["expert"].append(expert(flight))
            log["flown"].append(min(max(log["expert"][-1] + noise, -1.0), 1.0))
            flight.fly(log["flown"][-1])
    print(
        f"{flights} flights, {STEP_S * len(log['flown']):.0f} s, "
        f"touchdown at {log['offset'][-1]:+.2f} m in the last"
    )
    return {name: np.array(values) for name, values in log.items()}


def main() -> None:
    """Make and write both files."""
    DATA.mkdir(exist_ok=True)
    write_quantised(DATA / "arena_small.npz", coarse(load_scene("arena")))
    scene = GaussianScene.load(DATA / "arena_small.npz")
    print(f"{len(scene)} Gaussians")
    arrays = {}
    for kind, how in FLIGHTS.items():
        arrays |= {f"{kind}_{name}": values for name, values in fly(scene, *how).items()}
    np.savez_compressed(DATA / "flights.npz", **arrays)


if __name__ == "__main__":
    main()
