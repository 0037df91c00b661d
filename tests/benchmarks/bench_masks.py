"""Masks of the leader: the paper's ellipse beside the mask of the leader's own Gaussians, over many
simulated views.

    python -m tests.benchmarks.bench_masks --out DIR               # table, and masks.png in DIR
    python -m tests.benchmarks.bench_masks --out DIR --scene hall.npz --leader leader.npz

A follower stands anywhere in the hall, the leader 1.5 to 14 m ahead of it in any attitude that it
may fly, wholly in the picture. The Gaussians' mask, with the hall around, holds the pixels that
they cover by half; it is the truth here. Smaller ellipsoids are tried too. Times are this
process's, with the leader placed.
"""

import argparse
import time
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

import numpy as np

from falconwing_kit.core.checks import Array
from falconwing_kit.core.files import short_name
from falconwing_kit.core.frames import pose_matrix, rotation_world_body
from falconwing_kit.flight.sources import fpv_camera
from falconwing_kit.scene import GaussianScene, leader_at, nose_camera_pose, render
from falconwing_kit.scene.arena import HALL_HIGH, HALL_LOW
from falconwing_kit.scene.masks import (
    MASK_THRESHOLD,
    Ellipsoid,
    Mask,
    alpha_image,
    ellipse_mask,
    mask_iou,
    paint_grey,
    visible_alpha_image,
)
from falconwing_kit.tools.cli.scene_input import open_scene
from falconwing_kit.tools.reports.page import ACCENT, PREDICTED, figure
from tests.benchmarks.bench_rollouts import machine

BINS_M = (1.5, 3.0, 5.0, 8.0, 14.0)
FACTORS = (1.0, 0.9, 0.8, 0.7, 0.6, 0.5)  # of the ellipsoid's axes; 1 is the paper's
CAMERA = fpv_camera(640, 480)
SHOWN = 3  # views in the figure


@dataclass(frozen=True, eq=False)
class View:
    """Both kinds of masks in one view."""

    T_world_camera: Array
    T_world_leader: Array
    truth: Mask  # (H, W) of the Gaussians
    visible: float  # share of the leader that nothing hides, 0..1
    ellipses: tuple[Mask, ...]  # (H, W) for each of FACTORS
    ms: tuple[float, float]  # for the first ellipse, and for the Gaussians

    @property
    def distance(self) -> float:
        """From the camera to the leader [m]."""
        return float(np.linalg.norm(self.T_world_leader[:3, 3] - self.T_world_camera[:3, 3]))


def poses(points_body: Array, rng: np.random.Generator) -> Iterator[tuple[Array, Array]]:
    """Camera and leader, T_world_camera and T_world_leader: all points of the leader inside hall
    and picture.
    """
    size = np.array([CAMERA.width, CAMERA.height])
    while True:
        roll, pitch, yaw = rng.uniform((-0.5, -0.2, -np.pi), (0.5, 0.2, np.pi))
        T_world_camera = nose_camera_pose(
            rng.uniform(HALL_LOW + 0.7, HALL_HIGH - 0.7), roll, pitch, yaw
        )
        u, v = rng.uniform(0.0, size)
        ray = np.array([(u - CAMERA.cx) / CAMERA.fx, (v - CAMERA.cy) / CAMERA.fy, 1.0])
        distance = np.exp(rng.uniform(*np.log((BINS_M[0], BINS_M[-1]))))
        p_world = T_world_camera[:3, 3] + T_world_camera[:3, :3] @ ray * distance / np.linalg.norm(
            ray
        )
        roll, pitch, turn = rng.uniform((-0.8, -0.35, -1.0), (0.8, 0.35, 1.0))
        T_world_leader = pose_matrix(rotation_world_body(roll, pitch, yaw + turn), p_world)
        points_world = points_body @ T_world_leader[:3, :3].T + p_world
        pixels, depth = CAMERA.project(points_world, T_world_camera)
        in_hall = (points_world > HALL_LOW).all() and (points_world < HALL_HIGH).all()
        if in_hall and (depth > 0.3).all() and (pixels > 0).all() and (pixels < size).all():
            yield T_world_camera, T_world_leader


def look(hall: GaussianScene, leader: GaussianScene, count: int, seed: int) -> list[View]:
    """So many views."""
    black, white, whole = (
        paint_grey(hall, 0.0),
        paint_grey(leader, 1.0),
        Ellipsoid.around(leader.means),
    )
    ellipsoids = [Ellipsoid(whole.centre_body, factor * whole.half_axes) for factor in FACTORS]
    found: list[View] = []
    for T_world_camera, T_world_leader in poses(leader.means, np.random.default_rng(seed)):
        times = [time.process_time()]
        ellipse_mask(whole, T_world_leader, CAMERA, T_world_camera)
        times.append(time.process_time())
        placed = leader_at(white, T_world_leader)
        seen = visible_alpha_image(black, placed, CAMERA, T_world_camera)
        times.append(time.process_time())
        ms = 1e3 * np.diff(times)
        visible = float(seen.sum() / alpha_image(placed, CAMERA, T_world_camera).sum())
        ellipses = tuple(
            ellipse_mask(each, T_world_leader, CAMERA, T_world_camera) for each in ellipsoids
        )
        if (seen >= MASK_THRESHOLD).any():
            found.append(
                View(
                    T_world_camera,
                    T_world_leader,
                    seen >= MASK_THRESHOLD,
                    visible,
                    ellipses,
                    (float(ms[0]), float(ms[1])),
                )
            )
        if len(found) == count:
            break
    return found


def table(found: list[View]) -> str:
    """The numbers by distance, as Markdown."""
    lines = [
        "| distance [m] | views | leader [px] | IoU, median (5-95 %) | ellipse / leader, area "
        "| best IoU, at axes x |"
    ]
    lines += ["|---|---|---|---|---|---|"]
    for low, high in [*pairwise(BINS_M), (BINS_M[0], BINS_M[-1])]:
        own = [view for view in found if low <= view.distance <= high]
        if not own:
            continue
        ious = np.array([[mask_iou(view.truth, each) for each in view.ellipses] for view in own])
        sizes = np.array([view.truth.sum() for view in own])
        ratio = np.median(
            [view.ellipses[0].sum() / size for view, size in zip(own, sizes, strict=True)]
        )
        spread, best = np.quantile(ious[:, 0], (0.05, 0.95)), int(np.median(ious, axis=0).argmax())
        middle = f"{np.median(ious[:, 0]):.2f} ({spread[0]:.2f}-{spread[1]:.2f}) | {ratio:.2f}"
        at_best = f"{np.median(ious[:, best]):.2f} at {FACTORS[best]:g}"
        lines.append(
            f"| {low:g} to {high:g} | {len(own)} | {np.median(sizes):.0f} | {middle} | {at_best} |"
        )
    hidden = np.mean([view.visible < 0.95 for view in found])
    ellipse, gaussians = np.median([view.ms for view in found], axis=0)
    lines += [
        "",
        f"something hides more than 5 % of the leader in {100.0 * hidden:.0f} % of the views",
    ]
    return "\n".join(
        [
            *lines,
            f"ms a mask, median: ellipse {ellipse:.1f}, Gaussians {gaussians:.1f}; {machine()}",
        ]
    )


def draw(found: list[View], hall: GaussianScene, leader: GaussianScene, path: Path) -> None:
    """IoU over distance, and views with the outlines of Gaussians (green) and ellipse (red),
    nearest first.
    """
    with figure(path, 1, SHOWN + 1, (13.0, 3.4), width_ratios=[1.2, *[1.0] * SHOWN]) as axes:
        chart, *pictures = axes[0]
        chart.figure.suptitle(
            "green: the leader's own Gaussians; red: the paper's ellipse", x=0.99, ha="right"
        )
        for place, colour, name in (
            (0, ACCENT, "the paper's"),
            (3, PREDICTED, f"axes x {FACTORS[3]:g}"),
        ):
            points = [(view.distance, mask_iou(view.truth, view.ellipses[place])) for view in found]
            chart.plot(*np.transpose(points), ".", color=colour, ms=4, label=name)
        chart.set(
            xlabel="distance [m]",
            ylabel="intersection over union [-]",
            ylim=(0, 1),
            title="SIMULATED: ellipses and Gaussians",
        )
        chart.legend()
        ordered = sorted(found, key=lambda view: view.distance)
        for ax, view in zip(pictures, ordered[:: max(1, len(ordered) // SHOWN)], strict=False):
            scenes = [hall, leader_at(leader, view.T_world_leader)]
            rows, columns = (
                np.flatnonzero((view.ellipses[0] | view.truth).any(axis=axis)) for axis in (1, 0)
            )
            half = 0.7 * max(np.ptp(rows), np.ptp(columns)) + 8
            ax.imshow(render(scenes, CAMERA, view.T_world_camera).rgb, interpolation="nearest")
            ax.contour(view.truth, [0.5], colors="lime", linewidths=1.0)
            ax.contour(view.ellipses[0], [0.5], colors=ACCENT, linewidths=1.0)
            ax.set(
                xlim=(columns.mean() - half, columns.mean() + half),
                ylim=(rows.mean() + half, rows.mean() - half),
            )
            ax.set_title(f"{view.distance:.1f} m: IoU {mask_iou(view.truth, view.ellipses[0]):.2f}")
            ax.set_axis_off()


def main() -> None:
    """Look, print the table, draw the figure."""
    parser = argparse.ArgumentParser(description="Masks of the leader: ellipse beside Gaussians")
    parser.add_argument("--out", type=Path, required=True, help="folder for masks.png")
    parser.add_argument("--scene", default="arena", help="the hall")
    parser.add_argument(
        "--leader", default="leader", help="the aircraft, in its body axes and so labelled"
    )
    parser.add_argument("--views", type=int, default=200)
    parser.add_argument("--seed", type=int, default=0)
    asked = parser.parse_args()
    asked.out.mkdir(parents=True, exist_ok=True)
    hall, leader = open_scene(asked.scene), open_scene(asked.leader)
    hall = leader_at(hall, None) if "leader" in hall.label_names else hall
    found = look(hall, leader, asked.views, asked.seed)
    print(
        f"SIMULATED: {asked.scene}, {asked.leader}, {CAMERA.width} x {CAMERA.height}\n\n"
        f"{table(found)}"
    )
    draw(found, hall, leader, asked.out / "masks.png")
    print(f"figure: {short_name(asked.out / 'masks.png')}")


if __name__ == "__main__":
    main()
