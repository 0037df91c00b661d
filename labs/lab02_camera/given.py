"""Lab 2, given: your course's numbers, two simulated views with log, undistortion, drawing."""

import json
from collections.abc import Callable
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

FOLDER = Path(__file__).parent
COHORT: dict[str, float] = json.loads((FOLDER / "cohort.json").read_text(encoding="utf-8"))

BLUE, ORANGE, GREEN = (
    "#0072B2",
    "#D55E00",
    "#009E73",
)  # distinguishable for colour-blind readers (Okabe and Ito)
PAD = np.array(
    [[1, 1, 0.1], [3, 1, 0.1], [3, 14, 0.1], [1, 14, 0.1], [1, 1, 0.1]]
)  # its top in the map [m]
MARKER = np.array(
    [[-0.4, 0, 0.35], [0.4, 0, 0.35], [0.4, 0, 1.15], [-0.4, 0, 1.15], [-0.4, 0, 0.35]]
)  # [m]

Array = NDArray[np.float64]
Project = Callable[[Array], Array]  # points in the map (N, 3) [m] -> pixels (N, 2)


def load_views() -> tuple[list[dict[str, Any]], dict[str, float], float, Array]:
    """Two views of the simulated hall, and what the autopilot logged beside them.

    Returns:
        views: each with image (H, W, 3) uint8, p_map (3,) [m], roll, pitch and heading [rad]. The
            heading is what a compass reads in your course's hall.
        lens: fx, fy, cx, cy [px] and k1, as the kit writes them.
        tilt: of the camera, down from the nose [rad].
        p_body_camera: (3,) where it sits [m].
    """
    import matplotlib.pyplot as plt

    record = json.loads((FOLDER / "data" / "views.json").read_text(encoding="utf-8"))
    views = []
    for number, row in enumerate(record["views"]):
        heading_deg = COHORT["runway_heading_deg"] + row["off_runway_deg"]
        roll, pitch, heading = np.radians([row["roll_deg"], row["pitch_deg"], heading_deg])
        image = plt.imread(FOLDER / "data" / f"view{number}.jpg")
        view = {
            "image": image,
            "p_map": np.array(row["p_map"]),
            "roll": roll,
            "pitch": pitch,
            "heading": heading,
        }
        views.append(view)
    return (
        views,
        record["lens"],
        float(np.radians(record["tilt_deg"])),
        np.array(record["p_body_camera"]),
    )


def undistorted(pixels: Array, lens: dict[str, float]) -> Array:
    """Where the same points would appear through the same lens with k1 = 0.

    Args:
        pixels: (N, 2) the first pixel's centre at (0, 0).
        lens: fx, fy, cx, cy [px], k1.

    Returns:
        (N, 2) counted alike.
    """
    focal, centre = (
        np.array([lens["fx"], lens["fy"]]),
        np.array([lens["cx"] - 0.5, lens["cy"] - 0.5]),
    )
    bent = (np.asarray(pixels) - centre) / focal
    straight = bent
    for _ in range(
        50
    ):  # the slope that the lens bends is known only through itself: repeat until it stays
        straight = bent / (1.0 + lens["k1"] * np.sum(straight**2, axis=-1, keepdims=True))
    return np.asarray(straight * focal + centre)


def draw_view(ax: Any, view: dict[str, Any], project: Project) -> None:
    """Draw a view, and over it the map's axes on the marker, the marker's edge and the pad's edge.

    Args:
        ax: of matplotlib.
        view: one of `load_views`.
        project: points in the map (N, 3) [m] -> pixels (N, 2), nan for what is behind.
    """
    height, width = view["image"].shape[:2]
    roll_deg, pitch_deg = np.degrees(view["roll"]), np.degrees(view["pitch"])
    ax.imshow(view["image"])
    ax.set_title(f"roll {roll_deg:.0f}°, pitch {pitch_deg:.0f}° (simulated)")
    for edge, colour, style in ((PAD, ORANGE, "-"), (MARKER, GREEN, "--")):
        ax.plot(*project(_along(edge)).T, style, color=colour)
    foot = np.array([0.0, 0.0, 0.75])
    for tip, name in zip(np.eye(3), "xyz", strict=True):
        ends = project(np.array([foot, foot + tip]))
        ax.annotate(
            "", ends[1], ends[0], arrowprops={"arrowstyle": "->", "color": "white", "linewidth": 2}
        )
        ax.annotate(name, ends[1], color="white", fontweight="bold")
    ax.set(xlim=(-0.5, width - 0.5), ylim=(height - 0.5, -0.5), xlabel="u [px]", ylabel="v [px]")


def draw_map(ax: Any, footprints: list[Array], cameras: list[Array]) -> None:
    """Draw the hall from above, and which part of the floor each view shows.

    Args:
        ax: of matplotlib.
        footprints: for each view, floor points (N, 3) under the image's border [m], nan where it
            shows no floor.
        cameras: for each view, the camera's place (3,) [m].
    """
    ax.plot([-8, 12, 12, -8, -8], [-22.5, -22.5, 17.5, 17.5, -22.5], color="black", label="walls")
    ax.plot(PAD[:, 0], PAD[:, 1], color=ORANGE, label="pad")
    for number, (points, place) in enumerate(zip(footprints, cameras, strict=True)):
        style = "-." if number else ":"
        ax.plot(points[:, 0], points[:, 1], style, color=BLUE, label=f"floor seen in view {number}")
        ax.plot(place[0], place[1], "s" if number else "o", color=BLUE)
        offset = (-52, -4) if number else (6, -4)
        ax.annotate(f"camera {number}", (place[0], place[1]), offset, textcoords="offset points")
    ax.set(
        xlim=(-9, 13),
        ylim=(-16, 19),
        aspect="equal",
        xlabel="x, right [m]",
        ylabel="y, along the runway [m]",
    )
    ax.legend(loc="lower center", fontsize=8)


def border(image: NDArray[np.uint8], margin: float = 1.0) -> Array:
    """Pixels (N, 2) along the border of an image (H, W, 3), some margin [px] inside."""
    right, bottom = image.shape[1] - 1.0 - margin, image.shape[0] - 1.0 - margin
    corners = [
        [margin, bottom],
        [margin, margin],
        [right, margin],
        [right, bottom],
        [margin, bottom],
    ]
    return _along(np.array(corners))


def _along(corners: Array, pieces: int = 40) -> Array:
    """Points along straight edges from corner to corner (M, D) -> ((M - 1) * pieces + 1, D)."""
    share = np.arange(pieces)[:, None] / pieces
    edges = [a + share * (b - a) for a, b in pairwise(corners)]
    return np.concatenate([*edges, corners[-1:]])
