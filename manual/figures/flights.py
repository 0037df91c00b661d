"""Simulated flights and images of the manual: loop, scenes and monitor -> figures, descriptions.

Each is simulated and labelled so. `make_figures.py` calls the functions of FLIGHTS.
"""

import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from falconwing_kit.aircraft.touchdown import LandingPad
from falconwing_kit.core.files import atomic_write
from falconwing_kit.core.flight_table import read_flight_table
from falconwing_kit.core.frames import camera_pose
from falconwing_kit.core.messages import COMMAND_NAMES, Pose
from falconwing_kit.data import data_path
from falconwing_kit.flight.sources import fpv_camera
from falconwing_kit.flight.tasks import LandingTask
from falconwing_kit.scene import load_scene, render
from falconwing_kit.scene.analog import AnalogVideo
from falconwing_kit.tools.trials.trials import fly_trials
from falconwing_kit.vision import FrameMonitor

sys.path.insert(0, str(Path(__file__).resolve().parent))  # this folder is not a package
from schematics import DARK, LIGHT, MIDDLE, drawing, hall_from_above

LANDINGS, FRAMES, STEP_S, SPEED = 10, 16, 0.05, 7.0
SHOWN_S = (20.0, 50.0)  # of the flight for identification
PICTURE_PX = (320, 240)

Pixels = NDArray[np.uint8]


def draw_approach(path: Path) -> str:
    """Draw ten landings of the expert, from above and from the side."""
    task, pad = LandingTask(), LandingPad()
    records = fly_trials(task, task.expert, LANDINGS, pilot="expert")
    with drawing(path, 6.6, 4.6, 2, 1, height_ratios=[2.4, 1.0], sharex=True) as (
        (above,),
        (side,),
    ):
        above.figure.set_layout_engine("compressed")  # both as wide as the hall: one scale along x
        hall_from_above(above)
        above.set_xlabel("")
        for record in records:
            x, y, z = np.array(record["path_m"]).T[:3]
            above.plot(x, y, color=DARK, lw=0.8)
            side.plot(x, z, color=DARK, lw=0.8)
        above.annotate(
            "hand over",
            (pad.x_start - 20.0, pad.y_centre),
            (-19.0, -7.0),
            ha="center",
            fontsize=8.5,
            arrowprops={"arrowstyle": "-|>", "color": MIDDLE},
        )
        side.fill_between(
            [pad.x_start, pad.x_start + pad.length], 0.0, pad.height, color=LIGHT, lw=0
        )
        side.set(ylim=(0.0, 2.6), xlabel="x, landing direction [m]", ylabel="height [m]")
    landed = sum(record["success"] for record in records)
    return f"""Ten simulated landings by the expert with ground-truth state, without a camera:
        {landed} of {LANDINGS} on the pad. Top, the hall from above: from about 20 m before the pad
        all paths run together onto its centre line; the hand-over point is there.
        Bottom, from the side: from 1.5 m height down a shallow slope, rounded before the pad."""


def draw_control_inputs(path: Path) -> str:
    """Draw commands and ground track of a flight suitable for identification."""
    table = read_flight_table(data_path("case02_calm.csv"))
    shown = (table.t >= SHOWN_S[0]) & (table.t <= SHOWN_S[1])
    t = table.t[shown]
    with drawing(path, 6.6, 3.4, 1, 2, width_ratios=[1.6, 1.0]) as ((sticks, track),):
        for k, name in enumerate(COMMAND_NAMES):
            values = table.commands[shown, k] - (0.5 if name == "throttle" else 0.0)
            sticks.plot(t, -1.6 * k + values, color=DARK, lw=1.0)
            sticks.axhline(-1.6 * k, color=LIGHT, lw=0.8)
        sticks.set_yticks([-1.6 * k for k in range(4)], COMMAND_NAMES)
        sticks.tick_params(axis="y", length=0)
        sticks.set(xlabel="time [s]", ylim=(-5.9, 1.2), xlim=SHOWN_S)
        sticks.spines["left"].set_visible(False)
        track.plot(*table.p_world[shown, :2].T, color=DARK, lw=1.0)
        track.plot(*table.p_world[shown][0, :2], "o", ms=6, color=DARK)
        track.set(xlabel="x [m]", ylabel="y [m]", aspect="equal", title="seen from above")
        track.title.set_fontsize(9.5)
    return """Half a minute of a simulated flight suitable for identification. Left, the four
        commands over time, each about its grey middle line: all four move, to both sides, at their
        own times, quick and slow. Right, the path from above: turns to both sides; the spikes are
        outlier poses, which the fit rejects."""


def draw_pictures(path: Path) -> str:
    """Draw four kinds of video; the description has the frame monitor's result after 0.8 s."""
    import cv2

    shown, said = [], []
    for name, change in KINDS.items():
        monitor, verdict, alarm = FrameMonitor(), None, None
        for k, picture in enumerate(approach_views()):
            verdict = monitor.update(change(picture, k), k * STEP_S)
            alarm = k if verdict.alert and alarm is None else alarm
        words = "no alarm" if alarm is None else f"alarm in image {alarm + 1}, {verdict.reason}"
        said.append(f"{name}: {words}")
        shown.append(change(approach_views()[-1], FRAMES - 1))
    edge = np.full((PICTURE_PX[1], 8, 3), 255, np.uint8)
    strip = np.concatenate([part for picture in shown for part in (picture, edge)][:-1], axis=1)
    with atomic_write(path) as file:
        file.write(
            cv2.imencode(".jpg", strip[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, 88])[1].tobytes()
        )
    return f"""Four simulated images of an approach, from left to right, and the frame
        monitor's results over {FRAMES} of each, 20 per second. {". ".join(said)}."""


def approach_views() -> list[Pixels]:
    """FRAMES images (H, W, 3) of a straight approach in the arena."""
    if not _VIEWS:
        arena, camera = load_scene("arena"), fpv_camera(*PICTURE_PX)
        for k in range(FRAMES):
            T_world_body = Pose(
                np.array([-16.0 + SPEED * STEP_S * k, -1.6, 1.5 - 0.02 * k]), 0.0, -0.03, 0.02
            ).T_world_body
            rgb = render(arena, camera, camera_pose(T_world_body)).rgb
            _VIEWS.append(np.rint(255.0 * rgb).astype(np.uint8))
    return _VIEWS


_VIEWS: list[Pixels] = []
BAD = AnalogVideo(snr_db=14.0)
KINDS: dict[str, Callable[[Pixels, int], Any]] = {
    "clean": lambda picture, k: picture,
    "noise at 14 dB": lambda picture, k: BAD.apply(picture, k),
    "frozen": lambda picture, k: approach_views()[min(k, 4)],
    "blue screen of a receiver without signal": lambda picture, k: np.full_like(
        picture, (20, 30, 160)
    ),
}
FLIGHTS: dict[str, Callable[[Path], str]] = {
    "approach": draw_approach,
    "sticks": draw_control_inputs,
    "pictures": draw_pictures,
}
