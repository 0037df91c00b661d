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


def moving_attitude() -> Any:
    """A film: yaw, pitch and roll one after the other, from outside and through the camera."""
    from matplotlib.figure import Figure

    from falconwing_kit.core import HALL_HIGH, HALL_LOW, camera_pose, pose_matrix
    from falconwing_kit.core import rotation_world_body as rotation
    from falconwing_kit.scene import PinholeCamera
    from falconwing_kit.tools.grading import moving_figure

    camera = PinholeCamera.from_fov_deg(320, 240, 78.0)
    (x0, y0, z0), (x1, y1, z1) = HALL_LOW, HALL_HIGH
    floor = [[[x, y0, z0], [x, y1, z0]] for x in np.linspace(x0, x1, 17)]
    floor += [[[x0, y, z0], [x1, y, z0]] for y in np.linspace(y0, y1, 9)]
    end = [[x1, y0, z0], [x1, y0, z1], [x1, y1, z1], [x1, y1, z0]]
    walls = [end, [[x0, y0, z1], [x1, y0, z1]], [[x0, y1, z1], [x1, y1, z1]]]
    pad, marker = (edge[:, [1, 0, 2]] * [1.0, -1.0, 1.0] for edge in (PAD, MARKER))  # kit's world
    lines = [(each, "0.7", 0.8) for each in floor] + [(each, "0.3", 1.2) for each in walls]
    lines += [(pad, ORANGE, 2.0), (marker, GREEN, 2.0)]
    points = [_along(np.array(each, float), 60) for each, _, _ in lines]

    figure = Figure(figsize=(8.4, 3.6))
    outside: Any = figure.add_axes((0.0, 0.05, 0.46, 0.84), projection="3d")
    inside: Any = figure.add_axes((0.53, 0.14, 0.45, 0.76))
    outside.set(xlim=(-1, 1), ylim=(-1, 1), zlim=(-1, 1), xticks=[], yticks=[], zticks=[])
    outside.view_init(elev=22, azim=-150)  # from behind the aircraft, on its left
    outside.set_xlabel("along the runway")
    wing = np.array([[1, 0, 0], [0.2, 0.9, 0], [-0.1, 0.9, 0], [-0.1, 0.1, 0], [-0.8, 0.3, 0]])
    shape = np.vstack([wing, wing[::-1] * [1.0, -1.0, 1.0]])  # in body axes
    skin = outside.plot([], [], [], color="black", linewidth=2)[0]
    axes = [
        outside.plot([], [], [], line, color=colour, linewidth=3, label=name)[0]
        for name, colour, line in (
            ("x, nose", BLUE, "-"),
            ("y, right wing", ORANGE, "--"),
            ("z, belly", GREEN, ":"),
        )
    ]
    outside.legend(loc="lower left", fontsize=7)
    drawn = [inside.plot([], [], color=c, linewidth=w)[0] for _, c, w in lines]
    inside.set(xlim=(0, 320), ylim=(240, 0), aspect="equal", xlabel="u [px]", ylabel="v [px]")
    inside.set_title("through the camera", fontsize=9)
    parts = (
        ("yaw", 20.0, "nose right"),
        ("pitch", 14.0, "nose up"),
        ("roll", 40.0, "right wing down"),
    )

    def draw(number: int) -> None:
        part, step = divmod(number, 20)
        name, most, positive = parts[part]
        value = most * np.sin(2.0 * np.pi * step / 20.0)
        angles = {"yaw": 0.0, "pitch": 0.0, "roll": 0.0, name: np.radians(value)}
        R = rotation(angles["roll"], angles["pitch"], angles["yaw"])
        skin.set_data_3d(*(R @ shape.T))
        for arrow, axis in zip(axes, R.T, strict=True):
            arrow.set_data_3d(*np.outer(axis, [0.0, 1.2]))
        outside.set_title(f"{name} {value:+.0f}°, positive: {positive}", fontsize=9)
        T = camera_pose(pose_matrix(R, np.array([-11.0, -1.0, 2.0])), np.zeros(3))
        for line, p_world in zip(drawn, points, strict=True):
            pixels, depth = camera.project(p_world, T)
            line.set_data(*np.where(depth[:, None] > 0.3, pixels, np.nan).T)

    words = "An aircraft yaws, pitches and rolls; the picture moves the other way each time."
    return moving_figure(figure, draw, 60, 0.1, words)
