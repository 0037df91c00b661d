"""Lab 3, given: your course's numbers, a small simulated scene in camera axes, and drawing."""

import json
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

FOLDER = Path(__file__).parent
COHORT: dict[str, float] = json.loads((FOLDER / "cohort.json").read_text(encoding="utf-8"))

LENS = {
    "fx": 100.0,
    "fy": 100.0,
    "cx": 80.0,
    "cy": 60.0,
}  # [px], the first pixel's centre at (0.5, 0.5)
WIDTH, HEIGHT = 160, 120  # [px]
BLUR_PX2 = 0.3  # what the kit adds to a splat's variances, which makes it about a pixel wide [px^2]
BACKGROUND = np.array([0.5, 0.5, 0.5])  # where nothing is

Array = NDArray[np.float64]


def load_scene() -> dict[str, Array]:
    """The small scene, as a file keeps it.

    Returns:
        means (N, 3) in the kit's world, x along the runway, y left, z up [m]; quaternions_xyzw (N,
        4); log_scales (N, 3); opacities (N,); colours (N, 3); T_world_camera (4, 4) of a camera
        whose axes are right, up, backwards.
    """
    with np.load(FOLDER / "data" / "scene.npz") as arrays:
        return {name: arrays[name].astype(float) for name in arrays.files}


def kit_view() -> Array:
    """What the kit's reference renderer makes of the scene (H, W, 3)."""
    with np.load(FOLDER / "data" / "kit_view.npz") as arrays:
        return np.asarray(arrays["rgb"].astype(float))


def to_camera(means: Array, covs: Array, T_world_camera: Array) -> tuple[Array, Array]:
    """Gaussians in camera axes, as in lab 2: means (N, 3) [m] and covariances (N, 3, 3) [m^2]."""
    R_camera_world = T_world_camera[:3, :3].T
    return (
        means - T_world_camera[:3, 3]
    ) @ R_camera_world.T, R_camera_world @ covs @ R_camera_world.T


def pixel_rows() -> Array:
    """Centres of all pixels (H, W, 2), row by row: u, v."""
    v, u = np.mgrid[:HEIGHT, :WIDTH] + 0.5
    return np.asarray(np.stack([u, v], axis=-1))


def render_rows(splat_alphas: Any, alpha_composite: Any, splats: tuple[Array, ...]) -> Array:
    """The slow loop: every splat at every pixel, row by row.

    Args:
        splat_alphas, alpha_composite: your functions.
        splats: means_px (N, 2), covs_px (N, 2, 2), opacities (N,), colours (N, 3), depths (N,).

    Returns:
        (H, W, 3).
    """
    means_px, covs_px, opacities, colours, depths = splats
    rows = []
    for pixels in pixel_rows():
        alphas = splat_alphas(pixels, means_px, covs_px, opacities)
        rows.append(alpha_composite(alphas, colours, depths, BACKGROUND)[0])
    return np.array(rows)


def draw_cloud(points_px: Array, mean_px: Array, cov_px: Array) -> None:
    """Draw projected points of one Gaussian, and its splat's ellipse at two standard deviations.

    Args:
        points_px: (K, 2).
        mean_px: (2,).
        cov_px: (2, 2) [px^2].
    """
    import matplotlib.pyplot as plt

    ax: Any = plt.subplots(figsize=(7, 4), layout="constrained")[1]
    angle = np.linspace(0.0, 2.0 * np.pi, 100)
    circle = np.stack([np.cos(angle), np.sin(angle)])
    ellipse = mean_px[:, None] + 2.0 * np.linalg.cholesky(cov_px) @ circle
    ax.plot(
        *points_px.T,
        ".",
        markersize=2,
        color="#999999",
        label="points of the cloud, projected one by one",
    )
    ax.plot(*ellipse, color="#D55E00", linewidth=2, label="your splat, two standard deviations")
    ax.set(xlabel="u [px]", ylabel="v [px]", aspect="equal", title="One Gaussian in the picture")
    ax.invert_yaxis()
    ax.legend(fontsize=8, loc="upper left", bbox_to_anchor=(1.0, 1.0))


def draw_comparison(own: Array, kit: Array, brightest: float = 5.0) -> None:
    """Draw your picture, the kit's (H, W, 3), and their difference on a scale in 1/255."""
    import matplotlib.pyplot as plt

    fig, axes = plt.subplots(1, 3, figsize=(15, 4), layout="constrained")
    for ax, image, title in zip(axes, (own, kit), ("yours", "the kit's"), strict=False):
        ax.imshow(np.clip(image, 0.0, 1.0))
        ax.set_title(title + " (simulated)")
    shown = axes[2].imshow(
        255.0 * np.abs(own - kit).max(axis=2), cmap="viridis", vmin=0.0, vmax=brightest
    )
    axes[2].set_title("difference")
    fig.colorbar(shown, ax=axes[2], extend="max", label="largest of the three colours [1/255]")
    for ax in axes:
        ax.set(xlabel="u [px]", ylabel="v [px]")


def draw_depth(depth: Array) -> None:
    """Draw a picture of depths (H, W) [m]; nan stays white."""
    import matplotlib.pyplot as plt

    fig, ax = plt.subplots(figsize=(6, 4))
    fig.colorbar(ax.imshow(depth, cmap="viridis"), ax=ax, label="depth of the surface [m]")
    ax.set(xlabel="u [px]", ylabel="v [px]", title="How far away your picture is")


def moving_orbit(count: int = 48) -> Any:
    """A film of the scene, drawn by the kit, from a camera that swings in front of it.

    Args:
        count: of the pictures.
    """
    from falconwing_kit.scene import GaussianScene, PinholeCamera, nose_camera_pose, render
    from falconwing_kit.tools.grading import moving_pictures

    arrays = {name: array.astype(np.float32) for name, array in load_scene().items()}
    scene = GaussianScene(
        arrays["means"],
        arrays["quaternions_xyzw"][:, [3, 0, 1, 2]],
        np.exp(arrays["log_scales"]),
        arrays["opacities"],
        ((arrays["colours"] - 0.5) / 0.28209479)[:, None, :],
    )
    camera, pictures = PinholeCamera(**LENS, width=WIDTH, height=HEIGHT), []
    for number in range(count):
        swing = np.radians(40.0) * np.sin(2.0 * np.pi * number / count)
        place = np.array([2.0 - 9.0 * np.cos(swing), -1.6 + 9.0 * np.sin(swing), 1.9])
        T_world_camera = nose_camera_pose(place, 0.0, -0.06, swing)
        rgb = render(scene, camera, T_world_camera, background=BACKGROUND).rgb
        pictures.append(np.round(255.0 * np.clip(rgb, 0.0, 1.0)).astype(np.uint8))
    words = "A hall of soft spots, seen from a camera that swings to the left and to the right."
    return moving_pictures(pictures, 0.1, words, 3 * WIDTH)
