"""Figures of README and manual: the kit's data and flights -> images with descriptions (.txt).

    .venv/bin/python manual/figures/make_figures.py            all of them, in two minutes
    .venv/bin/python manual/figures/make_figures.py ppm hall   these

Drawings are in schematics.py, simulated flights and images in flights.py, figures of the hardware
in hardware/; pictures of the assembly's steps by hardware/assembly/draw.py, which needs the extra
`cad`. Here: views of halls, and the demo's results for recorded flights. Run it again when these
change.
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
from falconwing_kit.sysid.shooting import fly_windows, select_windows
from falconwing_kit.tools.demo.alfa import AlfaAnalysis
from falconwing_kit.tools.demo.recorded import RecordedFlights, study_recorded_flights
from falconwing_kit.tools.reports.page import ACCENT, MEASURED, PREDICTED, QUIET, figure

VIEW_PX = (400, 300)
VIEWS = (  # own and leader's x, y, z [m], roll, pitch, yaw [deg]
    ((-19.0, 0.5, 1.6, 0.0, -2.0, 3.0), None),
    ((-10.0, 2.0, 2.0, -15.0, 0.0, 12.0), (-7.6, 1.55, 2.2, 22.0, 6.0, 22.0)),
    ((-4.0, -1.4, 1.0, 4.0, -5.0, 1.0), None),
)
APPROACH_PX = (600, 400)
# poses for views of the trained hall
APPROACH = ((-12.0, 0.5, 1.5, 0.0, -3.0, 0.0), (-6.0, -2.0, 1.2, 0.0, -3.0, 5.0))
FOLDER = Path(__file__).resolve().parent
SHOWN_S = 10.0  # of the simulated flight: one held-out block
BEFORE_S = 30.0  # of the real flight, before its engine stops
CHANNELS = (
    (3, "roll [deg]", 180.0 / np.pi),
    (4, "pitch [deg]", 180.0 / np.pi),
    (2, "height [m]", 1.0),
)


def main(words: list[str] | None = None) -> int:
    """Draw the named figures, or all; `words` None takes the command line."""
    sys.path.insert(0, str(FOLDER))  # this folder is not a package
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
        "names", nargs="*", metavar="NAME", help=f"of {', '.join(names)}; all if none is given"
    )
    parser.add_argument("--out", type=Path, default=FOLDER, help="folder to write to")
    arguments = parser.parse_args(words)
    if set(arguments.names) - set(names):
        parser.error(
            f"expected names of {', '.join(names)}, "
            f"got {' '.join(set(arguments.names) - set(names))}"
        )
    arguments.out.mkdir(parents=True, exist_ok=True)
    for file, draw in drawings.items():
        if not arguments.names or Path(file).stem in arguments.names:
            description = " ".join(draw(arguments.out / file).split())
            write_description(arguments.out / Path(file).with_suffix(".txt"), description)
            print(f"{file}: {(arguments.out / file).stat().st_size / 1000:.0f} kB")
    if not arguments.names or "hardware" in arguments.names:
        draw_hardware(arguments.out)
    return 0


def write_description(path: Path, text: str) -> None:
    """Write a figure's description."""
    with atomic_write(path, text=True) as file:
        file.write(text + "\n")


def draw_hardware(out: Path) -> None:
    """Draw the figures of hardware/ from its own files: curves, wiring, bracket."""
    for name in ("draw", "wiring/wiring", "bracket/draw"):
        spec = importlib.util.spec_from_file_location(
            Path(name).stem, FOLDER.parents[1] / "hardware" / f"{name}.py"
        )
        if spec is None or spec.loader is None:
            raise FileNotFoundError(
                f"hardware/{name}.py: expected the script, got none; use a complete checkout"
            )
        script = importlib.util.module_from_spec(spec)
        spec.loader.exec_module(script)
        script.main(["--out", str(out)])


def draw_demo(path: Path) -> str:
    """Analyse the demo's flights and draw them; the description."""
    draw_identify_demo(study_recorded_flights(print), path)
    return """Left, ten seconds of a simulated flight of a 150 g aircraft: measured roll, pitch and
        height as dots, and 2 s predictions of the model as lines that coincide with the dots.
        Right, a real aircraft of 2 m span: before the engine failure the along-track errors of 1 s
        predictions are within the grey band of nominal flight; some seconds after it the
        prediction with the throttle before the failure is metres ahead of the aircraft, while its
        measured speed falls."""


def draw_hall(path: Path) -> str:
    """Draw three onboard views side by side: far out, behind a leader, short of the pad."""
    arena, camera = load_scene("arena"), fpv_camera(*VIEW_PX)
    images = []
    for own, leader in VIEWS:
        scene = leader_at(arena, None if leader is None else body_pose(leader))
        images.append(render(scene, camera, camera_pose(body_pose(own))).rgb)
    write_strip(path, images)
    return """Three simulated views into a drawn sports hall from an aircraft's nose: far out with
        the blue pad ahead, in a turn behind another aircraft, and short of the pad beside a square
        black and white marker."""


def draw_trained_hall(path: Path) -> str:
    """Draw two views from an approach of the hall that was trained on photos."""
    hall, camera = load_scene("hall"), fpv_camera(*APPROACH_PX)
    write_strip(path, [render(hall, camera, camera_pose(body_pose(own))).rgb for own in APPROACH])
    return """Two simulated views from an approach into the hall trained on path-traced images:
        windows, posters, boxes, the marker and the blue pad. The floor close by is blurred on the
        left and sharp on the right."""


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
    """Draw both flights side by side: the figure of README."""
    with figure(path, 3, 2, (10.0, 5.4), width_ratios=[1.0, 1.05]) as axes:
        draw_simulated(axes[:, 0], found.small)
        draw_real(axes[:, 1], found.alfa)


def draw_simulated(axes: Any, found: Identification) -> None:
    """Draw 2 s predictions over one held-out block on three axes, one per channel.

    Raises:
        ValueError: the flight is too short to hold data out.
    """
    if found.held_out is None:
        raise ValueError(
            "figure: expected a flight with held-out data, got a short one; use a longer one"
        )
    windows = select_windows(found.windows, found.held_out_index)
    begin = windows.nodes[0, 0]
    block = np.flatnonzero(windows.nodes[:, -1] < begin + SHOWN_S + 0.5)
    predicted = fly_windows(
        found.train_model, select_windows(windows, block), found.held_out.initial_states[block]
    )
    for ax, (channel, label, scale) in zip(axes, CHANNELS, strict=True):
        for k, poses in zip(block, predicted[..., channel] * scale, strict=True):
            t, observed = windows.nodes[k], windows.weight[k, :, channel] > 0
            ax.plot(
                t[observed], windows.pose[k, observed, channel] * scale, ".", ms=3.2, color=MEASURED
            )
            ax.plot(t, poses, "-", lw=1.6, color=PREDICTED)
            ax.plot(t[0], poses[0], "o", ms=4.5, color=ACCENT)
        ax.set_ylabel(label)
        ax.label_outer()
    axes[0].set_title("Simulated, 150 g: 2 s predictions")
    axes[2].set_xlabel("time [s]")
    axes[0].plot([], [], ".", color=MEASURED, label="measured pose")
    axes[0].plot([], [], "-", color=PREDICTED, label="model, from logged inputs")
    axes[0].plot([], [], "o", ms=4.5, color=ACCENT, label="initial state")
    axes[0].legend(loc="lower right", fontsize=8.0, borderaxespad=0.0, labelspacing=0.2)


def draw_real(axes: Any, analysis: AlfaAnalysis) -> None:
    """Draw along-track errors around the engine failure on the upper two axes, speed below."""
    grid = axes[0].get_gridspec()
    drawing = axes[0].figure
    for ax in axes[:2]:
        ax.remove()
    ahead, speed = drawing.add_subplot(grid[:2, 1], sharex=axes[2]), axes[2]
    begin = analysis.failure_time - BEFORE_S
    styles = (
        ("nominal", "-", ACCENT, 2.4, "prediction with the throttle before"),
        ("logged", "--", PREDICTED, 1.6, "prediction with the logged throttle"),
    )
    for name, line, colour, width, label in styles:
        t, error = analysis.along_track[name]
        ahead.plot(t[t > begin], error[t > begin], line, color=colour, lw=width, label=label)
    ahead.axhspan(-analysis.nominal_error, analysis.nominal_error, color="#eeeeee", zorder=0)
    text = "grey: errors before the failure"
    ahead.annotate(
        text,
        (begin, -analysis.nominal_error),
        (4, 5),
        textcoords="offset points",
        fontsize=8.5,
        color=QUIET,
    )
    if analysis.detection_time is not None:
        ahead.axvline(analysis.detection_time, color=QUIET, lw=1.0, ls="-.")
        late = f"{analysis.detection_time - analysis.failure_time:.1f} s later:\ndetected"
        ahead.annotate(
            late, (analysis.detection_time, -0.45), (6, 0), textcoords="offset points", fontsize=8.5
        )
    ahead.set_title("Real, 2 m span: 1 s predictions")
    ahead.set_ylabel("ahead of the aircraft [m]")
    ahead.tick_params(labelbottom=False)
    ahead.legend(loc="upper left", fontsize=8.5)
    over_ground = np.sqrt(sum(analysis.table.extra[name] ** 2 for name in ("vx", "vy", "vz")))
    shown = analysis.table.t > begin
    speed.plot(analysis.table.t[shown], over_ground[shown], "-", color=MEASURED, lw=2.0)
    speed.set_ylabel("measured\nspeed [m/s]")
    speed.set_xlabel("time [s]")
    for ax in (ahead, speed):
        ax.axvline(analysis.failure_time, color=ACCENT, lw=1.2, ls=":")
    mark = {"textcoords": "offset points", "ha": "right", "fontsize": 8.5, "color": ACCENT}
    speed.annotate("engine off", (analysis.failure_time, over_ground[shown].min()), (-4, 2), **mark)


if __name__ == "__main__":
    sys.exit(main())
