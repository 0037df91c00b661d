"""Lab 6, given: photos with their places, lens, marker, homography, refinement, and figures."""

import csv
import json
from pathlib import Path
from typing import Any

import numpy as np

COHORT: dict[str, float] = json.loads(
    (Path(__file__).parent / "cohort.json").read_text(encoding="utf-8")
)
DATA = Path(__file__).parent / "data"

K = np.array(
    [[396.66, 0.0, 320.0], [0.0, 396.66, 240.0], [0.0, 0.0, 1.0]]
)  # of the camera [px], no distortion
MARKER_SIZE = 0.80  # side of the black square [m]
CORNER_NOISE_PX = 0.3  # of a corner that OpenCV's detector finds in these photos
# Marker axes: x to the right of who looks at it, y up, z out of it. It faces the approach, -x of
# the world; its centre is 0.75 m above the floor.
T_WORLD_MARKER = np.array(
    [[0.0, 0.0, -1.0, 0.0], [-1.0, 0.0, 0.0, 0.0], [0.0, 1.0, 0.0, 0.75], [0.0, 0.0, 0.0, 1.0]]
)

BLUE, ORANGE, GREEN = (
    "#0072B2",
    "#D55E00",
    "#009E73",
)  # distinguishable for colour-blind readers (Okabe and Ito)


def read_photos() -> dict[str, Any]:
    """All 230 photos of the hall (path-traced), and the 72 of them that show the marker.

    Returns:
        "p_sfm" (230, 3) and "R_sfm_camera" (230, 3, 3): pose of each photo by structure from
        motion, in its own axes and unit; "p_world" (230, 3): reference [m]; "shows": (72,) numbers
        of the photos that show the marker; "corners_px": (72, 4, 2) where: top left, top right,
        bottom right, bottom left of the black square.
    """
    names, cameras = _table("cameras.csv")
    seen, corners = _table("sightings.csv")
    return {
        "p_sfm": cameras[:, 0:3],
        "R_sfm_camera": cameras[:, 3:12].reshape(-1, 3, 3),
        "p_world": cameras[:, 12:15],
        "shows": np.array([names.index(name) for name in seen]),
        "corners_px": corners.reshape(-1, 4, 2),
    }


def _table(name: str) -> tuple[list[str], np.ndarray]:
    with open(DATA / name, newline="", encoding="utf-8") as file:
        rows = list(csv.reader(file))[1:]
    return [row[0] for row in rows], np.array([row[1:] for row in rows], float)


def marker_square(size: float) -> np.ndarray:
    """(4, 2) x and y of the marker's corners in marker axes [m], in the order of `corners_px`."""
    return 0.5 * size * np.array([[-1.0, 1.0], [1.0, 1.0], [1.0, -1.0], [-1.0, -1.0]])


def homography(xy: np.ndarray, uv: np.ndarray) -> np.ndarray:
    """The 3 x 3 matrix H, with H[2, 2] = 1, that maps four points of a plane to four pixels.

    (u, v, 1) ~ H (x, y, 1): each point gives two equations that are linear in the other eight
    entries.

    Args:
        xy: (4, 2) in the plane.
        uv: (4, 2) in the image [px].

    Returns:
        H (3, 3).
    """
    rows = []
    for (x, y), (u, v) in zip(xy, uv, strict=True):
        rows += [
            [x, y, 1.0, 0.0, 0.0, 0.0, -u * x, -u * y],
            [0.0, 0.0, 0.0, x, y, 1.0, -v * x, -v * y],
        ]
    return np.append(np.linalg.solve(np.array(rows), np.ravel(uv)), 1.0).reshape(3, 3)


def polish(
    T_marker_camera: np.ndarray,
    corners_px: np.ndarray,
    size: float = MARKER_SIZE,
    parts: Any = None,
) -> np.ndarray:
    """Refine a camera pose by Gauss-Newton on the marker's corner pixels.

    Args:
        T_marker_camera: (4, 4) a rough pose.
        corners_px: (4, 2) found.
        size: of the marker [m].
        parts: whose lab 2 projects the corners; None for the two lines below.

    Returns:
        T_marker_camera (4, 4), a better one.
    """
    p_marker = np.column_stack([marker_square(size), np.zeros(4)])

    def moved(step: np.ndarray) -> np.ndarray:
        T = np.array(T_marker_camera)
        T[:3, :3] = T[:3, :3] @ _turn(step[:3])
        T[:3, 3] += T[:3, :3] @ step[3:]
        return T

    lens = {"fx": K[0, 0], "fy": K[1, 1], "cx": K[0, 2] + 0.5, "cy": K[1, 2] + 0.5, "k1": 0.0}

    def miss(T: np.ndarray) -> np.ndarray:
        if parts is not None:  # lab 2 counts the first pixel's centre as (0, 0), as OpenCV does
            p_camera = parts.camera.map_to_camera(p_marker, T)
            return np.asarray(parts.camera.project_points(p_camera, lens)) - corners_px
        p_camera = (p_marker - T[:3, 3]) @ T[:3, :3]
        return (p_camera @ K.T)[:, :2] / p_camera[:, 2:] - corners_px

    damping = 1e-3
    for _ in range(60):
        now = miss(T_marker_camera).ravel()
        J = np.array([(miss(moved(h)).ravel() - now) / 1e-6 for h in 1e-6 * np.eye(6)]).T
        normal = J.T @ J
        better = moved(-np.linalg.solve(normal + damping * np.diag(np.diag(normal)), J.T @ now))
        gain = (now**2).sum() - (miss(better) ** 2).sum()
        if gain > 0.0:
            T_marker_camera, damping = better, 0.3 * damping
            if gain < 1e-10:
                break
        else:
            damping *= 5.0
    return T_marker_camera


def _turn(rotation_vector: np.ndarray) -> np.ndarray:
    """Rotation about a vector by its length [rad], by Rodrigues' formula."""
    angle = float(np.linalg.norm(rotation_vector))
    x, y, z = rotation_vector / max(angle, 1e-12)
    cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    return np.eye(3) + np.sin(angle) * cross + (1.0 - np.cos(angle)) * cross @ cross


def draw_crops() -> None:
    """The marker in the nearest and in the farthest photo, pixel by pixel."""
    import matplotlib.pyplot as plt

    axes: Any = plt.subplots(1, 2, figsize=(8, 3.2), layout="constrained")[1]
    with np.load(DATA / "crops.npz") as crops:
        for ax, (name, metres) in zip(axes, (("near", 3.0), ("far", 21.7)), strict=True):
            ax.imshow(crops[name], interpolation="nearest")
            ax.set(title=f"from {metres} m", xlabel="[px]", ylabel="[px]")


def draw_distance(distance: np.ndarray, rough: np.ndarray, polished: np.ndarray) -> None:
    """Error of single-photo poses over distance, with what theory expects.

    Args:
        distance: (n,) from the marker [m].
        rough: (n,) errors of the homography's places [m].
        polished: (n,) errors after the polish [m].
    """
    import matplotlib.pyplot as plt

    ax: Any = plt.subplots(figsize=(8, 5), layout="constrained")[1]
    ax.loglog(distance, rough, "x", color=ORANGE, label="homography")
    ax.loglog(distance, polished, "o", mfc="none", color=BLUE, label="polished")
    z = np.geomspace(2.8, 24.0, 50)
    focal = K[0, 0]
    ax.loglog(
        z,
        z**2 * CORNER_NOISE_PX / (focal * MARKER_SIZE),
        ":",
        color="black",
        label="along the view: ~ Z²",
    )
    ax.loglog(
        z,
        z**3 * CORNER_NOISE_PX / (focal * MARKER_SIZE**2),
        "--",
        color="black",
        label="across it: ~ Z³",
    )
    ax.set(
        xlabel="distance from the marker [m]",
        ylabel="error of the camera's place [m]",
        ylim=(0.01, 40.0),
    )
    ax.set_xticks([3, 4, 6, 8, 10, 15, 20], ["3", "4", "6", "8", "10", "15", "20"])
    ax.set_xticks([], minor=True)
    ax.grid(alpha=0.3)
    ax.legend()


def draw_hall(p_world: np.ndarray, placed: dict[str, np.ndarray]) -> None:
    """The hall from above with the first and last recipe, and the error of all.

    Args:
        p_world: (n, 3) where the photos were taken [m].
        placed: by the recipe's name, (n, 3) where it puts them [m].
    """
    import matplotlib.pyplot as plt

    fig: Any = plt.figure(figsize=(10, 7.5), layout="constrained")
    above, bars = fig.subplots(2, 1, height_ratios=(2.2, 1.0))
    above.plot(
        [-22.5, 17.5, 17.5, -22.5, -22.5],
        [-12.0, -12.0, 8.0, 8.0, -12.0],
        color="black",
        label="wall",
    )
    above.fill([1.0, 14.0, 14.0, 1.0], [-3.0, -3.0, -1.0, -1.0], color="#9fc5e8", label="pad")
    above.plot([0.0, 0.0], [-0.4, 0.4], color=GREEN, linewidth=5, label="marker")
    names = list(placed)
    # the first and the last recipe that work
    for name, colour, look in zip(names[:1] + names[-1:], (ORANGE, BLUE), "xo", strict=False):
        p = placed[name]
        above.plot(
            *np.stack([p_world[:, :2], p[:, :2]]).transpose(2, 0, 1), color=colour, linewidth=0.7
        )
        above.plot(p[:, 0], p[:, 1], look, color=colour, markersize=4, label=f"placed: {name}")
    above.plot(
        p_world[:, 0],
        p_world[:, 1],
        ".",
        color="black",
        markersize=4,
        label="where they were taken",
    )
    above.set(
        xlabel="x [m]", ylabel="y [m]", aspect="equal", xlim=(-27.0, 21.0), ylim=(-15.0, 11.0)
    )
    above.legend(loc="center left", bbox_to_anchor=(1.0, 0.5), fontsize="small")
    for row, p in enumerate(placed.values()):
        miss = np.linalg.norm(p - p_world, axis=1)
        bars.plot([miss.mean(), miss.max()], [row, row], "-", color="0.6")
        bars.plot(miss.mean(), row, "o", color=BLUE, label="mean" if row == 0 else None)
        bars.plot(
            miss.max(), row, "|", color=ORANGE, markersize=14, label="largest" if row == 0 else None
        )
        bars.text(1.15 * miss.max(), row, f"{miss.mean():.2f} / {miss.max():.2f} m", va="center")
    bars.set_xscale("log")
    bars.set(
        xlabel="error over all photos [m]",
        yticks=range(len(placed)),
        ylim=(len(placed) - 0.5, -0.5),
        xlim=(0.05, 60.0),
    )
    bars.set_yticklabels(names)
    bars.legend(loc="lower right", fontsize="small")


def moving_photos() -> Any:
    """A film: every second photo that shows the marker, from the farthest to the nearest."""
    from matplotlib.figure import Figure

    from falconwing_kit.tools.grading import moving_figure

    photos = read_photos()
    places = photos["p_world"][photos["shows"]]
    distance = np.linalg.norm(places - T_WORLD_MARKER[:3, 3], axis=1)
    order = np.argsort(-distance)[::-2][::-1]  # every second one, the nearest too
    figure = Figure(figsize=(8.4, 3.6), layout="constrained")
    above, seen = figure.subplots(1, 2, width_ratios=(1.15, 1.0))
    above.plot([-22.5, 17.5, 17.5, -22.5, -22.5], [-12, -12, 8, 8, -12], color="black", lw=1)
    above.plot([0.0, 0.0], [-0.4, 0.4], color=GREEN, linewidth=5, label="marker")
    above.plot(*places[:, :2].T, ".", color="0.7", label="photos that show it")
    here = above.plot([], [], "o-", color=ORANGE, markevery=[0], label="this photo")[0]
    above.set(xlabel="x [m]", ylabel="y [m]", aspect="equal")
    above.set_ylim(-21.0, 9.0)
    above.legend(fontsize=8, loc="lower center", ncols=3)
    square = seen.fill([0], [0], facecolor=BLUE, edgecolor="black")[0]
    seen.set(xlim=(0, 640), ylim=(480, 0), aspect="equal", xlabel="u [px]", ylabel="v [px]")

    def draw(number: int) -> None:
        photo = order[number]
        corners = photos["corners_px"][photo]
        here.set_data([places[photo, 0], 0.0], [places[photo, 1], 0.0])
        square.set_xy(corners)
        side = np.linalg.norm(corners - np.roll(corners, 1, axis=0), axis=1).max()
        above.set_title(f"taken {distance[photo]:.1f} m away (path-traced)", fontsize=9)
        seen.set_title(f"the marker's longest side: {side:.0f} px", fontsize=9)

    words = (
        "Photo by photo nearer to the marker; its square grows from some 15 to more than 100 px."
    )
    return moving_figure(figure, draw, len(order), 0.25, words)
