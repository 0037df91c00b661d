"""Make lab 3's data again: python labs/lab03_splats/make_data.py

A hall of some hundred Gaussians, small enough for a slow renderer, in the way files keep them
(scales as logarithms, quaternions x y z w), and what the kit's reference renderer makes of it. All
of it is simulated.
"""

from pathlib import Path

import numpy as np

from falconwing_kit.core import Array, atomic_write
from falconwing_kit.scene import GaussianScene, PinholeCamera, nose_camera_pose, render

DATA = Path(__file__).parent / "data"
CAMERA = PinholeCamera(100.0, 100.0, 80.0, 60.0, 160, 120)
POSE = nose_camera_pose((-7.0, -1.6, 1.9), *np.radians((8.0, -6.0, -5.0)))
OVERLAP, THICKNESS = 0.55, 0.01  # standard deviation of a piece by its side, and across it [m]
SH_C0 = 0.28209479177387814  # Y_0, the spherical harmonic of degree 0
FIELD = 1.25  # what lies further out than this part of the half field of view is left out
MARKER = (
    "########",
    "#..##..#",
    "#.#..#.#",
    "##.##.##",
    "##.##.##",
    "#.#..#.#",
    "#..##..#",
    "########",
)


def sheet(
    corner: Array, u: Array, v: Array, size: float, colours: Array, rng: np.random.Generator
) -> list[Array]:
    """Gaussians that tile a flat sheet: means, quaternions w x y z, scales, colours.

    Args:
        corner: (3,) of the sheet [m].
        u, v: (3,) unit vectors along its sides.
        size: of a piece [m].
        colours: (rows along v, columns along u, 3), 0..1.
        rng: draws the grain.
    """
    from scipy.spatial.transform import Rotation

    rows, columns = colours.shape[:2]
    j, i = np.mgrid[:rows, :columns].reshape(2, -1)
    means = corner + size * ((i[:, None] + 0.5) * u + (j[:, None] + 0.5) * v)
    turn = Rotation.from_matrix(np.column_stack([u, v, np.cross(u, v)])).as_quat(scalar_first=True)
    scales = np.tile([OVERLAP * size, OVERLAP * size, THICKNESS], (len(means), 1))
    grain = 1.0 + 0.08 * rng.normal(size=(len(means), 1))
    return [
        means,
        np.tile(turn, (len(means), 1)),
        scales,
        np.clip(colours.reshape(-1, 3) * grain, 0.0, 1.0),
    ]


def plain(rows: int, columns: int, colour: tuple[float, float, float]) -> Array:
    """One colour for all pieces (rows, columns, 3)."""
    return np.tile(np.array(colour), (rows, columns, 1))


def aircraft(place: Array) -> list[Array]:
    """An aircraft of seven ellipsoids that flies level towards +x."""
    pieces = [  # centre, standard deviations [m], colour
        ((0.0, 0.0, 0.0), (0.22, 0.04, 0.05), (0.96, 0.96, 0.94)),
        ((0.28, 0.0, 0.0), (0.08, 0.035, 0.035), (0.86, 0.15, 0.12)),
        ((0.05, 0.33, 0.07), (0.07, 0.17, 0.012), (0.86, 0.15, 0.12)),
        ((0.05, -0.33, 0.07), (0.07, 0.17, 0.012), (0.86, 0.15, 0.12)),
        ((0.05, 0.0, 0.07), (0.07, 0.15, 0.015), (0.96, 0.96, 0.94)),
        ((-0.38, 0.0, 0.02), (0.05, 0.14, 0.012), (0.86, 0.15, 0.12)),
        ((-0.40, 0.0, 0.10), (0.05, 0.012, 0.07), (0.15, 0.26, 0.72)),
    ]
    centres, scales, colours = (np.array(column) for column in zip(*pieces, strict=True))
    return [place + centres, np.tile([1.0, 0.0, 0.0, 0.0], (len(pieces), 1)), scales, colours]


def hall(rng: np.random.Generator) -> list[Array]:
    """Floor, pad, two walls, marker and aircraft, as columns."""
    x, y, z = np.eye(3)
    oak, blue, plaster, panels = (
        (0.72, 0.53, 0.33),
        (0.09, 0.27, 0.76),
        (0.86, 0.83, 0.76),
        (0.62, 0.45, 0.28),
    )
    wall = np.concatenate([plain(2, 20, panels), plain(3, 20, plaster)])
    side = np.concatenate([plain(2, 24, panels), plain(3, 24, plaster)])
    side[2:4, 1::4] = side[2:4, 2::4] = (0.75, 0.88, 0.98)  # windows
    bits = np.array([[0.05 if bit == "#" else 0.96 for bit in row] for row in MARKER])
    board = np.pad(bits, 1, constant_values=0.96)[:, :, None].repeat(3, axis=2)
    pieces = [
        sheet(np.array([-6.0, -8.0, 0.0]), x, y, 1.0, plain(16, 24, oak), rng),
        sheet(np.array([1.0, -3.0, 0.1]), x, y, 0.5, plain(4, 26, blue), rng),
        sheet(np.array([17.5, 8.0, 0.0]), -y, z, 1.0, wall, rng),
        sheet(np.array([-6.0, 8.0, 0.0]), x, z, 1.0, side, rng),
        sheet(np.array([0.0, 0.5, 0.25]), -y, z, 0.1, board, rng),
        aircraft(np.array([-3.0, -1.7, 1.9])),
    ]
    return [np.concatenate(column) for column in zip(*pieces, strict=True)]


def main() -> None:
    """Write scene.npz and kit_view.npz."""
    means, quaternions, scales, colours = hall(np.random.default_rng(3))
    p_camera = (means - POSE[:3, 3]) @ POSE[:3, :3]
    limits = FIELD * np.array([CAMERA.width / CAMERA.fx, CAMERA.height / CAMERA.fy]) / 2.0
    seen = (p_camera[:, 2] > 1.0) & (np.abs(p_camera[:, :2] / p_camera[:, 2:]) < limits).all(axis=1)
    shuffled = np.random.default_rng(4).permutation(np.flatnonzero(seen))  # files are not sorted
    means, quaternions, scales, colours = (
        column[shuffled] for column in (means, quaternions, scales, colours)
    )
    opacities = np.full(len(means), 0.97)
    scene = GaussianScene(
        means, quaternions, scales, opacities, ((colours - 0.5) / SH_C0)[:, None, :]
    )
    view = render(scene, CAMERA, POSE, backend="reference", background=(0.5, 0.5, 0.5))
    arrays = {
        "means": means.astype(np.float32),
        "quaternions_xyzw": np.roll(quaternions, -1, axis=1).astype(np.float32),
        "log_scales": np.log(scales).astype(np.float32),
        "opacities": opacities.astype(np.float32),
        "colours": colours.astype(np.float32),
        "T_world_camera": POSE
        @ np.diag([1.0, -1.0, -1.0, 1.0]),  # the lab's camera: right, up, backwards
    }
    with atomic_write(DATA / "scene.npz") as file:
        np.savez_compressed(file, **arrays)
    with atomic_write(DATA / "kit_view.npz") as file:
        np.savez_compressed(file, rgb=view.rgb.astype(np.float16))
    print(f"{len(means)} Gaussians; opaque in {(view.alpha > 0.5).mean():.0%} of the image")


if __name__ == "__main__":
    main()
