"""Every figure of README and manual, made again -> this folder, each with the same in words beside
it (.txt).

    .venv/bin/python manual/figures/make_figures.py            all of them, in two minutes
    .venv/bin/python manual/figures/make_figures.py ppm hall   these

Drawings are in schematics.py, simulated flights and pictures in flights.py, hardware's own in
hardware/. Here: views of halls, and what the demo found in recorded flights. Run it again when the
demo's answer changes.
"""

import argparse
import importlib.util
import sys
from pathlib import Path
from typing import Any

import numpy as np

from falconwing_kit.core.checks import Array
from falconwing_kit.core.files import atomic_write
from falconwing_kit.core.frames import camera_pose
from falconwing_kit.core.messages import Pose
from falconwing_kit.flight.sources import fpv_camera
from falconwing_kit.scene import leader_at, load_scene, render
from falconwing_kit.sysid.identify import Identification
from falconwing_kit.sysid.score import select_windows
from falconwing_kit.sysid.shooting import fly_windows
from falconwing_kit.tools.demo.alfa_story import AlfaAnalysis
from falconwing_kit.tools.demo.recorded import RecordedFlights, study_recorded_flights
from falconwing_kit.tools.reports.page import ACCENT, MEASURED, PREDICTED, QUIET, figure

VIEW_PX = (400, 300)
VIEWS = (  # own and leader's x, y, z [m], roll, pitch, yaw [deg]
    ((-19.0, 0.5, 1.6, 0.0, -2.0, 3.0), None),
    ((-10.0, 2.0, 2.0, -15.0, 0.0, 12.0), (-7.6, 1.55, 2.2, 22.0, 6.0, 22.0)),
    ((-4.0, -1.4, 1.0, 4.0, -5.0, 1.0), None),
)
APPROACH_PX = (600, 400)
APPROACH = (
    (-12.0, 0.5, 1.5, 0.0, -3.0, 0.0),
    (-6.0, -2.0, 1.2, 0.0, -3.0, 5.0),
)  # into the trained hall
FOLDER = Path(__file__).resolve().parent
SHOWN_S = 10.0  # of the simulated flight: one block of the time that was kept back
BEFORE_S = 30.0  # of the real flight, before its engine stops
CHANNELS = (
    (3, "roll [deg]", 180.0 / np.pi),
    (4, "pitch [deg]", 180.0 / np.pi),
    (2, "height [m]", 1.0),
)


def main(words: list[str] | None = None) -> int:
    """Draw the figures that are named, or all.

    Args:
        words: the command line; None takes the program's own.

    Returns:
        0.
    """
    sys.path.insert(0, str(FOLDER))  # this folder is no package
    from flights import FLIGHTS
    from schematics import DRAWINGS

    drawings = {f"{name}.svg": draw for name, draw in DRAWINGS.items()}
    drawings |= {
        f"{name}.{'jpg' if name == 'pictures' else 'svg'}": draw for name, draw in FLIGHTS.items()
    }
    drawings |= {
        "hall.jpg": draw_hall,
        "trained_hall.jpg": draw_trained_hall,
        "identify_demo.png": draw_demo,
    }
    parser = argparse.ArgumentParser(description="Figures of README and manual.")
    names = [*(Path(name).stem for name in drawings), "hardware"]
    parser.add_argument(
        "names", nargs="*", metavar="NAME", help=f"of {', '.join(names)}; all where none is given"
    )
    parser.add_argument("--out", type=Path, default=FOLDER, help="folder to write to")
    asked = parser.parse_args(words)
    if set(asked.names) - set(names):
        parser.error(
            f"expected names of {', '.join(names)}, got {' '.join(set(asked.names) - set(names))}"
        )
    asked.out.mkdir(parents=True, exist_ok=True)
    for file, draw in drawings.items():
        if not asked.names or Path(file).stem in asked.names:
            said = " ".join(draw(asked.out / file).split())
            write_words(asked.out / Path(file).with_suffix(".txt"), said)
            print(f"{file}: {(asked.out / file).stat().st_size / 1000:.0f} kB")
    if not asked.names or "hardware" in asked.names:
        draw_hardware(asked.out)
    return 0


def write_words(path: Path, text: str) -> None:
    """A figure in words."""
    with atomic_write(path, text=True) as file:
        file.write(text + "\n")


def draw_hardware(out: Path) -> None:
    """The figures that hardware/ draws from its own files: curves, wiring, bracket.

    Args:
        out: the folder to write to.
    """
    for name in ("draw", "wiring/wiring", "bracket/draw"):
        spec = importlib.util.spec_from_file_location(
            Path(name).stem, FOLDER.parents[1] / "hardware" / f"{name}.py"
        )
        if spec is None or spec.loader is None:
            raise FileNotFoundError(
                f"hardware/{name}.py: expected the script that draws, found none; take a whole checkout"
            )
        script = importlib.util.module_from_spec(spec)
        spec.loader.exec_module(script)
        script.main(["--out", str(out)])


def draw_demo(path: Path) -> str:
    """Study the demo's flights, draw them, and say what is seen."""
    draw_identify_demo(study_recorded_flights(print), path)
    return """Left, ten seconds of a simulated flight of 150 g: roll, pitch and height as measured, dots, and as the
        model says from two seconds before, lines that lie on the dots. Right, a real aircraft 2 m wide: until its
        engine stops forecasts stay within the grey band of healthy flight; some seconds after it the forecast of an
        engine that runs on is metres ahead of the aircraft, while its measured speed falls."""


def draw_hall(path: Path) -> str:
    """Three looks from an aircraft's nose side by side: far out, behind a leader, and short of the
    pad.

    Args:
        path: the JPEG to write.

    Returns:
        The same in words.
    """
    arena, camera = load_scene("arena"), fpv_camera(*VIEW_PX)
    images = []
    for own, leader in VIEWS:
        scene = leader_at(arena, None if leader is None else body_pose(leader))
        images.append(render(scene, camera, camera_pose(body_pose(own))).rgb)
    write_strip(path, images)
    return """Three simulated views into a drawn sports hall from an aircraft's nose: far out with the blue pad
        ahead, in a turn behind another aircraft, and short of the pad beside a square black and white marker."""


def draw_trained_hall(path: Path) -> str:
    """Two looks from an approach into the hall that was trained on photos.

    Args:
        path: the JPEG to write.

    Returns:
        The same in words.
    """
    hall, camera = load_scene("hall"), fpv_camera(*APPROACH_PX)
    write_strip(path, [render(hall, camera, camera_pose(body_pose(own))).rgb for own in APPROACH])
    return """Two simulated views from an approach into the hall trained on path-traced images: windows, posters,
        boxes, the marker and the blue pad. The floor close by is blurred on the left and sharp on the right."""


def write_strip(path: Path, images: list[Any]) -> None:
    """Images (H, W, 3) of 0..1 side by side as a JPEG."""
    import cv2

    strip = np.concatenate(images, axis=1)
    path.write_bytes(
        cv2.imencode(".jpg", np.rint(255.0 * strip[..., ::-1]).astype(np.uint8))[1].tobytes()
    )


def body_pose(pose: tuple[float, ...]) -> Array:
    """T_world_body (4, 4) of a position [m] and roll, pitch, yaw [deg]."""
    roll, pitch, yaw = np.radians(pose[3:])
    return Pose(np.array(pose[:3]), roll, pitch, yaw).T_world_body


def draw_identify_demo(found: RecordedFlights, path: Path) -> None:
    """Both flights side by side: the picture of README.

    Args:
        found: what the demo found.
        path: the PNG to write.
    """
    with figure(path, 3, 2, (10.0, 5.4), width_ratios=[1.0, 1.05]) as axes:
        draw_simulated(axes[:, 0], found.small)
        draw_real(axes[:, 1], found.alfa)


def draw_simulated(axes: Any, found: Identification) -> None:
    """Two-second predictions over one block of time that the model was not fitted to.

    Args:
        axes: three, one a channel.
        found: the identification of the 150 g aircraft.

    Raises:
        ValueError: the flight is too short to keep time back.
    """
    if found.held_out is None:
        raise ValueError(
            "figure: expected a flight with time kept back, got one that is too short; take a longer one"
        )
    windows = select_windows(found.windows, found.held_out_index)
    begin = windows.nodes[0, 0]
    block = np.flatnonzero(windows.nodes[:, -1] < begin + SHOWN_S + 0.5)
    predicted = fly_windows(
        found.train_model, select_windows(windows, block), found.held_out.initial_states[block]
    )
    for ax, (channel, label, scale) in zip(axes, CHANNELS, strict=True):
        for k, poses in zip(block, predicted[..., channel] * scale, strict=True):
            t, seen = windows.nodes[k], windows.weight[k, :, channel] > 0
            ax.plot(t[seen], windows.pose[k, seen, channel] * scale, ".", ms=3.2, color=MEASURED)
            ax.plot(t, poses, "-", lw=1.6, color=PREDICTED)
            ax.plot(t[0], poses[0], "o", ms=4.5, color=ACCENT)
        ax.set_ylabel(label)
        ax.label_outer()
    axes[0].set_title("Simulated, 150 g: two seconds ahead")
    axes[2].set_xlabel("time [s]")
    axes[0].plot([], [], ".", color=MEASURED, label="measured pose")
    axes[0].plot([], [], "-", color=PREDICTED, label="model, on the sticks alone")
    axes[0].plot([], [], "o", ms=4.5, color=ACCENT, label="starts from here")
    axes[0].legend(loc="lower right", fontsize=8.0, borderaxespad=0.0, labelspacing=0.2)


def draw_real(axes: Any, story: AlfaAnalysis) -> None:
    """How far forecasts run ahead of the real aircraft around its engine's failure, and its speed.

    Args:
        axes: three; the upper two are joined.
        story: the real flight's.
    """
    grid = axes[0].get_gridspec()
    drawing = axes[0].figure
    for ax in axes[:2]:
        ax.remove()
    ahead, speed = drawing.add_subplot(grid[:2, 1], sharex=axes[2]), axes[2]
    begin = story.failure_time - BEFORE_S
    looks = (
        ("healthy", "-", ACCENT, 2.4, "forecast for an engine that runs on"),
        ("told", "--", PREDICTED, 1.6, "forecast that is told the throttle"),
    )
    for name, line, colour, width, label in looks:
        t, error = story.running[name]
        ahead.plot(t[t > begin], error[t > begin], line, color=colour, lw=width, label=label)
    ahead.axhspan(-story.nominal_error, story.nominal_error, color="#eeeeee", zorder=0)
    text = "grey: what healthy flight showed"
    ahead.annotate(
        text,
        (begin, -story.nominal_error),
        (4, 5),
        textcoords="offset points",
        fontsize=8.5,
        color=QUIET,
    )
    if story.detection_time is not None:
        ahead.axvline(story.detection_time, color=QUIET, lw=1.0, ls="-.")
        late = f"{story.detection_time - story.failure_time:.1f} s later\nit shows"
        ahead.annotate(
            late, (story.detection_time, -0.45), (6, 0), textcoords="offset points", fontsize=8.5
        )
    ahead.set_title("Real, 2 m wide: one second ahead")
    ahead.set_ylabel("ahead of the aircraft [m]")
    ahead.tick_params(labelbottom=False)
    ahead.legend(loc="upper left", fontsize=8.5)
    over_ground = np.sqrt(sum(story.table.extra[name] ** 2 for name in ("vx", "vy", "vz")))
    shown = story.table.t > begin
    speed.plot(story.table.t[shown], over_ground[shown], "-", color=MEASURED, lw=2.0)
    speed.set_ylabel("measured\nspeed [m/s]")
    speed.set_xlabel("time [s]")
    for ax in (ahead, speed):
        ax.axvline(story.failure_time, color=ACCENT, lw=1.2, ls=":")
    mark = {"textcoords": "offset points", "ha": "right", "fontsize": 8.5, "color": ACCENT}
    speed.annotate("engine off", (story.failure_time, over_ground[shown].min()), (-4, 2), **mark)


if __name__ == "__main__":
    sys.exit(main())
