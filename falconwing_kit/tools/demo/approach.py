"""The demo's approach: a landing in the simulated hall -> its log; figures of any flight log."""

import os
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import ExitStack, closing
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from falconwing_kit.aircraft.touchdown import LandingPad
from falconwing_kit.core.checks import Array, InputError
from falconwing_kit.core.files import atomic_write, short_name, write_error
from falconwing_kit.core.flight_log import (
    FlightLog,
    FlightLogWriter,
    read_flight_log,
    to_flight_table,
)
from falconwing_kit.core.flight_table import FlightTable
from falconwing_kit.core.messages import CONTROL_PERIOD_S
from falconwing_kit.flight.image_pilot import ImagePilot
from falconwing_kit.flight.loop import (
    Clock,
    Loop,
    LoopResult,
    LoopStep,
    Pilot,
    SimulatedClock,
)
from falconwing_kit.flight.loop import PacedClock as PacedClock
from falconwing_kit.flight.metadata import flight_metadata
from falconwing_kit.flight.pilots import load_pilot
from falconwing_kit.flight.sources import (
    TIME_ROUNDING,
    MeasuredStates,
    RenderedView,
    decode_jpeg,
    fpv_camera,
    log_start_time,
)
from falconwing_kit.flight.supervisor import Supervisor
from falconwing_kit.flight.tasks import LandingTask, trial_seed
from falconwing_kit.scene.analog import AnalogVideo
from falconwing_kit.scene.gaussians import GaussianScene
from falconwing_kit.tools.bridge.python_board import PythonBoard
from falconwing_kit.tools.bridge.through_port import PortWorld
from falconwing_kit.tools.classroom.supervise import PACED_LIMITS
from falconwing_kit.tools.reports.page import ACCENT, PREDICTED, QUIET, figure, render
from falconwing_kit.vision.occlusion import PATCH_PX, STRIDE_PX, Seen, occlusion_sensitivity
from falconwing_kit.vision.policy import Policy

PART = Path(__file__).with_name("approach.html.j2")
SEEN = "flight_seen.png"
FIGURES = ("flight_fpv.png", "flight_path.png", "flight_sticks.png", "flight_film.png")
PORT = "sim-python"  # the simulated board of the approach
CAMERA_PILOT, TRAINED_SCENES = "student", ("hall", "hall_analog")
HANDED_BACK = "handed back"  # the loop's event where the supervisor found a fault
PAD_BLUE = "#3d6fd6"
STRIP_IMAGES = 6  # images in the strip
FILM_HZ, FILM_COLOURS = 10.0, 256  # about a megabyte
FILM_FRAMES = 200  # maximum, which bounds the memory: a long flight has fewer a second
FILM_MAP = 300  # width of the maps beside the view [px]


@dataclass(frozen=True, eq=False)
class Approach:
    """A landing in the simulated hall."""

    log: Path
    flight: LoopResult
    result: dict[str, Any]  # of the evaluation: success, ald_m, sink_rate_m_s, ...
    hall: str = ""  # source of the scene
    pilot: str = "expert"
    policy: Policy | None = None  # of a pilot by images
    seen: tuple[tuple[float, Seen], ...] = ()  # time [s], and what its command was made of

    @property
    def end(self) -> str:
        """Why the loop ended, with the supervisor's reason where it handed back."""
        why = [event.details["reason"] for event in self.flight.events if event.name == HANDED_BACK]
        return ": ".join([self.flight.reason, *why])


def fly_approach(
    scene: GaussianScene,
    log: Path,
    hooks: Sequence[Callable[[LoopStep], None]] = (),
    clock: Clock | None = None,
    seed: int = 0,
    link: AnalogVideo | None = None,
    scene_name: str = "arena",
) -> Approach:
    """Fly a landing through a simulated trainer port, with everything logged.

    In the trained hall the pilot "student" lands by the camera's images alone; elsewhere, where no
    network was trained, the expert by the noisy pose.

    Args:
        log: the MCAP file to write; an existing one is replaced after a complete flight only.
        hooks: called with every step.
        clock: None for simulated time, as fast as possible.
        seed: selects one of the fixed initial states, about 20 m out and 1.5 m up.
        link: analog video link of the camera; None for none.
        scene_name: of the scene, for the log: a name that ships, or a file.

    Raises:
        KeyboardInterrupt: Ctrl-C.
        InputError: the log cannot be written.
        FileNotFoundError: its folder does not exist.
    """
    task = LandingTask()
    trial, camera = task.trial(trial_seed(0, seed)), fpv_camera()
    name = approach_pilot(scene_name)
    pilot: Pilot = task.expert(trial)
    seen: list[tuple[float, Seen]] = []

    def look(step: LoopStep) -> None:
        if isinstance(pilot, ImagePilot) and pilot.seen is not None:
            seen.append((step.t, pilot.seen))

    if name == CAMERA_PILOT:
        pilot = load_pilot(name, camera=camera, p_body_camera_m=task.airframe.p_body_camera)
    partial = log.with_name(f".{log.name}.part")
    partial.unlink(missing_ok=True)
    try:
        with ExitStack() as stack:
            writer = stack.enter_context(FlightLogWriter(partial))
            writer.metadata(flight_metadata(task, trial, scene=scene_name, pilot=name, port=PORT))
            board = stack.enter_context(closing(PythonBoard()))
            world = stack.enter_context(PortWorld(trial.world, board, on_event=writer.event))
            view = RenderedView(world, scene, camera, task.airframe.p_body_camera, link=link)
            judge = task.judge(trial, camera, view)
            loop = Loop(
                pilot,
                world,
                view,
                MeasuredStates(world),  # for the log; a pilot by images does not read them
                clock=clock or SimulatedClock(),
                log=writer,
                hooks=(look, *hooks),
                supervisor=Supervisor(PACED_LIMITS),
            )
            flight = loop.run(trial.duration, judge.watch)
        if flight.reason == "interrupted":
            raise KeyboardInterrupt
        os.replace(partial, log)
    except OSError as error:
        raise write_error(log, error) from None
    finally:
        partial.unlink(missing_ok=True)
    policy = pilot.policy if isinstance(pilot, ImagePilot) else None
    return Approach(log, flight, judge.result(), scene.source, name, policy, tuple(seen))


def approach_pilot(scene_name: str) -> str:
    """The pilot that flies the approach in a scene."""
    return CAMERA_PILOT if scene_name in TRAINED_SCENES else "expert"


def mode_at(log: FlightLog, t: float) -> str:
    """The pilot's mode at a time since the log's start [s]; empty if not logged."""
    now = log_start_time(log) + t + TIME_ROUNDING
    return next((str(word) for begin, word in reversed(_modes(log)) if begin <= now), "")


def _modes(log: FlightLog) -> list[tuple[float, Any]]:
    return [
        (event.t, event.details.get("mode", "")) for event in log.events if event.name == "mode"
    ]


def is_simulated(log: FlightLog) -> bool:
    """Whether a log's metadata marks it as simulated."""
    return log.metadata.get("simulated") == "yes"


def draw_approach(approach: Approach, folder: Path) -> tuple[Path, ...]:
    """Write the figures of `draw_flight`, and where a pilot by images looks (flight_seen.png)."""
    paths = draw_flight(approach.log, folder)
    if approach.policy is None or not approach.seen:
        return paths
    draw_sensitivity(approach.policy, approach.seen, folder / SEEN)
    return *paths, folder / SEEN


def draw_flight(path: Path, folder: Path) -> tuple[Path, ...]:
    """Write the figures of a flight from its log.

    Args:
        path: the log (MCAP), with poses.
        folder: for the figures; it must exist.

    Returns:
        flight_path.png and flight_sticks.png; with images also flight_fpv.png and flight_film.png.

    Raises:
        FileNotFoundError: there is no log.
        InputError: the log cannot be read, or has no poses to draw.
    """
    log = read_flight_log(path)
    table = to_flight_table(log)
    if table.has_pose.sum() < 2:
        raise InputError(
            f"{short_name(path)}: expected a log with at least two poses, "
            f"got {table.has_pose.sum()}"
        )
    what = "SIMULATION" if is_simulated(log) else "FLIGHT"
    fpv, along, sticks, film = (folder / name for name in FIGURES)
    draw_path(table, along, what)
    draw_control_inputs(table, _modes(log), sticks, what)
    if not len(log.image_times):
        return along, sticks
    draw_strip(log, table, fpv, what)
    draw_film(log, table, film, what)
    return fpv, along, sticks, film


def draw_strip(log: FlightLog, table: FlightTable, path: Path, what: str) -> None:
    """Draw a few camera images, evenly spaced along the path; `what` is SIMULATION or FLIGHT."""
    rows = np.flatnonzero(table.has_pose)
    # arc length along the path, and the rows nearest to equal parts of it
    steps = np.linalg.norm(np.diff(table.p_world[rows], axis=0), axis=1)
    length = np.concatenate([[0.0], np.cumsum(steps)])
    shares = np.arange(STRIP_IMAGES) / STRIP_IMAGES
    chosen = [rows[np.argmin(np.abs(length - share * length[-1]))] for share in shares]
    images = dict(_images_at(log, table.t[chosen]))
    with figure(path, 2, STRIP_IMAGES // 2, (8.0, 4.5)) as axes:
        for ax, row in zip(axes.flat, chosen, strict=True):
            x, _, height = table.p_world[row]
            if float(table.t[row]) in images:
                ax.imshow(images[float(table.t[row])])
            ax.set_title(f"{table.t[row]:.1f} s: x {x:.1f} m, height {height:.2f} m")
            ax.set_axis_off()
        axes[0, 0].figure.suptitle(
            f"{what}: onboard camera view", x=0.01, ha="left", fontweight="bold"
        )


def draw_sensitivity(policy: Policy, seen: Sequence[tuple[float, Seen]], path: Path) -> None:
    """Draw what moves a pilot's command in a few images, evenly spaced in time.

    Args:
        policy: that flew.
        seen: time [s], and what its command was made of, of every step.
        path: the PNG to write.
    """
    chosen = [seen[k] for k in np.linspace(0, len(seen) - 1, STRIP_IMAGES).round().astype(int)]
    maps = [occlusion_sensitivity(policy, what) for _, what in chosen]
    with figure(path, 2, STRIP_IMAGES // 2, (8.0, 4.9)) as axes:
        for ax, (t, what), change in zip(axes.flat, chosen, maps, strict=True):
            ax.imshow(what.image)
            # each square's middle part, which no other square's covers
            rows, columns = change.shape
            low = 0.5 * (PATCH_PX - STRIDE_PX) - 0.5
            extent = (low, low + STRIDE_PX * columns, low + STRIDE_PX * rows, low)
            drawn = ax.imshow(
                change, cmap="inferno", alpha=0.55, extent=extent, vmin=0.0, vmax=change.max(),
                interpolation="bilinear",
            )  # fmt: skip
            ax.set_xlim(-0.5, what.image.shape[1] - 0.5)
            ax.set_ylim(what.image.shape[0] - 0.5, -0.5)
            ax.set_title(f"{t:.1f} s: up to {change.max():.2f}")
            ax.set_axis_off()
        bar = axes[0, 0].figure.colorbar(drawn, ax=axes, shrink=0.8, ticks=[0.0, change.max()])
        bar.ax.set_yticklabels(["none", "most"])
        bar.set_label("change of the command where hidden")
        axes[0, 0].figure.suptitle(
            "SIMULATION: where the pilot looks", x=0.01, ha="left", fontweight="bold"
        )


def draw_path(table: FlightTable, path: Path, what: str) -> None:
    """Draw the path from above and from the side, with the pad; `what` as in `draw_strip`."""
    from matplotlib.patches import Rectangle

    pad = LandingPad()
    x, y, z = table.p_world[table.has_pose].T
    with figure(path, 2, 1, (11.0, 4.8), sharex=True, height_ratios=[1.0, 1.0]) as axes:
        above, aside = axes[:, 0]
        low = pad.y_centre - pad.width / 2.0
        above.add_patch(
            Rectangle((pad.x_start, low), pad.length, pad.width, color=PAD_BLUE, alpha=0.55, lw=0)
        )
        aside.add_patch(
            Rectangle((pad.x_start, 0.0), pad.length, pad.height, color=PAD_BLUE, alpha=0.8, lw=0)
        )
        above.axhline(pad.y_centre, color=QUIET, lw=0.8, ls=":")
        for ax, across, label in ((above, y, "y, to the left [m]"), (aside, z, "height [m]")):
            ax.plot(x, across, color=ACCENT, lw=2.0)
            ax.plot(x[[0]], across[[0]], "o", color=ACCENT, ms=5)
            ax.plot(x[[-1]], across[[-1]], "s", color=ACCENT, ms=5)
            ax.set_ylabel(label)
        above.set_ylim(min(y.min(), low) - 0.8, max(y.max(), low + pad.width) + 0.8)
        aside.set_ylim(0.0, 1.15 * max(float(z.max()), 0.5))
        above.set_title(
            f"{what}: path from above and from the side; dot: start, square: end, blue: the pad"
        )
        aside.set_xlabel("x, along the runway [m]")


def draw_control_inputs(
    table: FlightTable, modes: Sequence[tuple[float, Any]], path: Path, what: str
) -> None:
    """Draw commands, height and speed over time, with the pilot's modes as (start [s], name)."""
    with figure(path, 3, 1, (11.0, 6.2), sharex=True, height_ratios=[1.5, 1.0, 1.0]) as axes:
        inputs, height, speed = axes[:, 0]
        styles = (
            ("throttle", QUIET, "-"),
            ("aileron", PREDICTED, "-"),
            ("elevator", ACCENT, "-"),
            ("rudder", PREDICTED, ":"),
        )
        for values, (name, colour, line) in zip(table.commands.T, styles, strict=True):
            inputs.step(table.t, values, where="post", color=colour, ls=line, lw=1.6, label=name)
        inputs.set_ylim(-1.05, 1.05)
        inputs.set_ylabel("commands [-]")
        inputs.legend(loc="upper right", ncols=4)
        inputs.set_title(f"{what}: commands, height and speed")
        height.plot(table.t, table.p_world[:, 2], color=PREDICTED, lw=1.8)
        speed.plot(table.t, speeds(table), color=ACCENT, lw=1.8)
        for ax, label in ((height, "height [m]"), (speed, "speed [m/s]")):
            ax.set_ylim(bottom=0.0)
            ax.set_ylabel(label)
        for begin, word in modes:
            for ax in axes[:, 0]:
                ax.axvline(begin, color=QUIET, lw=0.8, ls="--")
            inputs.annotate(
                str(word),
                (begin, -1.0),
                (4, 2),
                textcoords="offset points",
                fontsize=9,
                color=QUIET,
            )
        speed.set_xlabel("time [s]")


def speeds(table: FlightTable) -> Array:
    """Speed over ground (N,) [m/s], from logged velocities or else from positions."""
    if all(name in table.extra for name in ("vx", "vy", "vz")):
        return np.asarray(np.sqrt(sum(table.extra[name] ** 2 for name in ("vx", "vy", "vz"))))
    return np.asarray(np.linalg.norm(np.gradient(table.p_world, table.t, axis=0), axis=1))


def draw_film(log: FlightLog, table: FlightTable, path: Path, what: str) -> None:
    """Write an animated PNG in real time: onboard view, path from above and from the side.

    One palette for all frames keeps the file small.
    """
    from PIL import Image as Drawing

    rows = np.flatnonzero(table.has_pose)
    begin, end = table.t[rows[0]], table.t[rows[-1]]
    period = max(1.0 / FILM_HZ, (end - begin) / FILM_FRAMES)
    wanted = np.arange(begin, end + 1e-6, period)[:FILM_FRAMES]
    rows = np.unique(rows[np.searchsorted(table.t[rows], wanted - 1e-6).clip(max=len(rows) - 1)])
    row_at = {float(table.t[row]): int(row) for row in rows}

    def frames(times: Sequence[float]) -> Iterator[tuple[float, Any]]:
        for t, pixels in _images_at(log, times):
            yield t, _film_frame(pixels, table, row_at[t], what)

    # the palette is computed from a few frames, quartered in size
    few = [*row_at][:: max(1, len(row_at) // 8)]
    samples = np.concatenate([np.asarray(frame)[::4, ::4].copy() for _, frame in frames(few)])
    palette = Drawing.fromarray(samples).quantize(FILM_COLOURS)
    film = {
        t: frame.quantize(palette=palette, dither=Drawing.Dither.NONE)
        for t, frame in frames([*row_at])
    }
    first, *others = (film[t] for t in sorted(film))
    with atomic_write(path) as handle:
        first.save(
            handle,
            "PNG",
            save_all=True,
            append_images=others,
            duration=1e3 * period,
            loop=0,
            optimize=True,
        )


def _film_frame(pixels: NDArray[np.uint8], table: FlightTable, row: int, what: str) -> Any:
    """One frame of the film: the image, and the path so far from above and from the side."""
    from PIL import Image as Drawing
    from PIL import ImageDraw, ImageFont

    high, wide = pixels.shape[:2]
    sheet = Drawing.new("RGB", (wide + FILM_MAP, high), "white")
    sheet.paste(Drawing.fromarray(pixels), (0, 0))
    pen, font, pad = ImageDraw.Draw(sheet), ImageFont.load_default(15), LandingPad()
    x, y, z = table.p_world[table.has_pose].T
    so_far = table.p_world[: row + 1][table.has_pose[: row + 1]]
    low = min(float(x.min()), pad.x_start) - 1.0
    right = max(float(x.max()), pad.x_start + pad.length) + 1.0
    begin, edge = pad.x_start, pad.width / 2.0
    across = max(float(np.abs(y - pad.y_centre).max()), edge) + 0.3
    # world axis, its zero and scale on the sheet [px], its centre, the pad's extent along it
    views = (
        (1, 0.40 * high, 0.20 * high / across, pad.y_centre, (-edge, edge)),
        (2, 0.95 * high, 0.30 * high / max(float(z.max()), 1.0), 0.0, (0.0, pad.height)),
    )
    for axis, zero, scale, middle, (bottom, top) in views:

        def place(
            along: float, over: float, zero: float = zero, scale: float = scale
        ) -> tuple[float, float]:
            return wide + (along - low) / (right - low) * FILM_MAP, zero - scale * over

        pen.rectangle((*place(begin, top), *place(begin + pad.length, bottom)), fill=PAD_BLUE)
        pen.line((*place(low, 0.0), *place(right, 0.0)), fill="#bbbbbb")
        pen.line([place(p[0], p[axis] - middle) for p in so_far], fill=ACCENT, width=2)
        u, v = place(so_far[-1, 0], so_far[-1, axis] - middle)
        pen.ellipse((u - 4, v - 4, u + 4, v + 4), fill=ACCENT)
    pen.text((wide + 10, 6), f"{what}  {table.t[row]:.1f} s", fill="black", font=font)
    pen.text((wide + 10, 26), "from above", fill=QUIET, font=font)
    pen.text(
        (wide + 10, 0.56 * high), f"from the side: {so_far[-1, 2]:.2f} m", fill=QUIET, font=font
    )
    return sheet


def _images_at(log: FlightLog, times: Iterable[float]) -> Iterator[tuple[float, NDArray[np.uint8]]]:
    """The images of given times with their times, one by one, since a log may exceed memory."""
    wanted = {float(t) for t in times}
    return ((image.t, decode_jpeg(image)) for image in log.images() if image.t in wanted)


def approach_record(approach: Approach) -> dict[str, Any]:
    """The approach as numbers, for demo.json."""
    result = {name: value for name, value in approach.result.items() if name != "path_m"}
    return {
        "made_by": "this kit, SIMULATED",
        "hall": approach.hall,
        "pilot": approach.pilot,
        "ended": approach.end,
        "seconds": len(approach.flight.t) * CONTROL_PERIOD_S,
        **result,
    }


def approach_section(approach: Approach, folder: Path) -> str:
    """The approach on the demo's page, as HTML; `folder` holds the figures of `draw_approach`."""
    fpv, along, sticks, film = (folder / name for name in FIGURES)
    return render(
        PART,
        result=approach.result,
        reason=approach.end,
        seconds=approach.flight.t[-1],
        hall=approach.hall,
        pilot=approach.pilot,
        log=approach.log.name,
        fpv=fpv,
        along=along,
        sticks=sticks,
        film=film,
        seen=folder / SEEN if approach.seen else None,
        patch=PATCH_PX,
    )
