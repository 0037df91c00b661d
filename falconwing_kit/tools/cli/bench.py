"""falconwing bench: measure camera and trainer port: lens, delay, frame rate, pulses."""

import sys
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import asdict, dataclass
from datetime import date
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from falconwing_kit.core.checks import Array, InputError, require_range
from falconwing_kit.core.files import require_writable_path
from falconwing_kit.tools.cli.calibrate import SIMULATED_PORTS
from falconwing_kit.tools.cli.show import next_line, print_json, print_table

if TYPE_CHECKING:
    from falconwing_kit.flight.loop import ImageSource
    from falconwing_kit.tools.devices.calibration import BenchCalibration
    from falconwing_kit.tools.devices.lens import LensFit
    from falconwing_kit.tools.devices.simulated_bench import SimulatedBench
    from falconwing_kit.trainer_port.port import TrainerPort

DEFAULT = Path("bench.toml")
LENS_WAIT_S = 180.0  # for all views of the checkerboard
MIN_MOTION = 0.05  # of the corners from each earlier view, in image widths
FIRST_IMAGE_S = 5.0
PHOTO_ENDINGS = (".jpg", ".jpeg", ".png", ".bmp", ".tif", ".tiff")


@dataclass(frozen=True)
class Bench:
    """Measure camera and trainer port on the bench, without an aircraft, for simulator and flight.

    Lens: hold a checkerboard before the camera. Delay: hold the camera above the LED on the board's
    pin 13 (most boards have one), in the middle of the image; a --port is needed. The file is for
    --bench of fly, record and poses. --port sim --camera sim is a dry run.
    """

    camera: str = "0"
    """number or path of the camera, or a video file; sim is a SIMULATED one"""
    port: str = ""
    """serial port of the trainer bridge, or sim with --camera sim; without it no delay and no
    pulses
    """
    skip: Literal["", "lens", "latency"] = ""
    """what to leave out"""
    checkerboard: str = "9x6"
    """its inner corners: in a row, and rows"""
    photos: Path | None = None
    """a folder of photos of the checkerboard, of the camera's size, in place of live images"""
    views: int = 20
    """views of the checkerboard"""
    cycles: int = 60
    """times that the LED is switched, a second and a half each"""
    calibration: Path | None = None
    """file of falconwing calibrate; without it ./trainer_port.toml, or the kit's default"""
    radio: str = ""
    """refuse a calibration of another radio"""
    out: Path = DEFAULT
    """the file to write"""
    replace: bool = False
    """overwrite an older file"""
    seed: int = 0
    """of the moments at which the LED is switched"""
    json: bool = False
    """print JSON instead of a table"""

    def run(self) -> int:
        """Measure, and write the file.

        Returns:
            0: the file is written.

        Raises:
            InputError: an option is wrong, a device does not answer, or a measurement is too
                uncertain.
        """
        pattern = self._check()
        with ExitStack() as stack:
            measured = self._measure(stack, pattern)
        from falconwing_kit.core.config import write_toml

        write_toml(self.out, measured)
        self._show(measured)
        return 0

    def _check(self) -> tuple[int, int]:
        """Refuse wrong options before any device is opened; the checkerboard's corners."""
        require_writable_path(self.out)
        if self.out.exists() and not self.replace:
            raise InputError(f"{self.out}: expected a new file, got one that exists; add --replace")
        require_range("--views", self.views, low=8, high=200)
        require_range("--cycles", self.cycles, low=10, high=1000)
        require_range("--seed", self.seed, low=0, high=2**31)
        if self.port and (self.port in SIMULATED_PORTS) != (self.camera == "sim"):
            raise InputError(
                f"--port {self.port}, --camera {self.camera}: expected both SIMULATED or neither,"
                " for the camera must see the board's LED"
            )
        if self.photos is not None and not self.photos.is_dir():
            raise FileNotFoundError(f"--photos {self.photos}: expected a folder, found none")
        words = self.checkerboard.split("x")
        if len(words) != 2 or not all(word.isdigit() and 3 <= int(word) <= 40 for word in words):
            raise InputError(
                "--checkerboard: expected its inner corners such as 9x6, 3 to 40 each, got"
                f" {self.checkerboard!r}"
            )
        return int(words[0]), int(words[1])

    def _measure(self, stack: ExitStack, pattern: tuple[int, int]) -> "BenchCalibration":
        from falconwing_kit.tools.devices.calibration import BenchCalibration
        from falconwing_kit.tools.devices.latency import (
            measure_frames,
            measure_latency,
            measure_ppm,
        )

        setup = self._open(stack)
        found: dict[str, Any] = {}
        if self.skip != "lens":
            found["lens"] = self._fit_lens(setup, pattern)
        found["frames"] = measure_frames(setup.images, setup.now, setup.sleep)
        if setup.port is not None:
            found["ppm"] = measure_ppm(setup.port, setup.sleep)
            if self.skip != "latency":
                setup.show_led()
                with _progress(self.cycles, "switch", self.json) as progress:
                    found["latency"] = measure_latency(
                        setup.port, setup.images, setup.sleep, found["ppm"], self.cycles,
                        self.seed, progress,
                    )  # fmt: skip
        return BenchCalibration(
            measured=date.today().isoformat(),
            simulated=self.camera == "sim",
            camera=self.camera,
            board="" if setup.port is None else setup.port.what,
            **found,
        )

    def _open(self, stack: ExitStack) -> "_Setup":
        """Camera and board."""
        if self.camera == "sim":
            return _open_simulated(stack, self.port)
        import time

        from falconwing_kit.tools.cli.board_status import open_ready_port
        from falconwing_kit.tools.devices.cameras import open_camera
        from falconwing_kit.tools.devices.grabber import Grabber

        images = stack.enter_context(Grabber(open_camera(self.camera)))
        if not images.wait(1, FIRST_IMAGE_S):
            raise InputError(
                f"--camera {self.camera}: expected an image, got none; {images.health.trouble}"
            )
        port = None
        if self.port:
            port = stack.enter_context(open_ready_port(self.port, self.calibration, self.radio))
        return _Setup(images, port, time.perf_counter, time.sleep)

    def _fit_lens(self, setup: "_Setup", pattern: tuple[int, int]) -> "LensFit":
        from falconwing_kit.tools.devices.lens import fit_lens

        with _progress(self.views, "view", self.json) as progress:
            if self.photos is None:
                views, size = self._live_views(setup, pattern, progress)
            else:
                views, size = _photo_views(self.photos, pattern, progress)
        return fit_lens(views, pattern, size)

    def _live_views(
        self, setup: "_Setup", pattern: tuple[int, int], progress: Callable[[], None]
    ) -> tuple[list[Array], tuple[int, int]]:
        """Corners of views that differ from each other, and the image's size."""
        import numpy as np

        from falconwing_kit.tools.devices.lens import find_corners

        print(
            f"hold a checkerboard of {self.checkerboard} inner corners before the camera; tilt and"
            " move it, also into the corners of the image",
            file=sys.stderr,
        )
        views: list[Array] = []
        size, end, newest, looks = (0, 0), setup.now() + LENS_WAIT_S, -1, 0
        while len(views) < self.views and setup.now() < end and not setup.is_over():
            setup.show_checkerboard(looks)
            setup.sleep(0.1)
            looks += 1
            image = setup.images.next_image(setup.now())
            if image is None or image.sequence == newest:
                continue
            newest, size = image.sequence, (image.pixels.shape[1], image.pixels.shape[0])
            corners = find_corners(image.pixels, pattern)
            if corners is not None and all(
                np.linalg.norm(corners - other, axis=1).mean() > MIN_MOTION * size[0]
                for other in views
            ):
                views.append(corners)
                progress()
        return views, size

    def _show(self, measured: "BenchCalibration") -> None:
        if self.json:
            print_json({"file": str(self.out.resolve()), **asdict(measured)})
            return
        title = f"{'SIMULATED ' if measured.simulated else ''}bench: {self.out.resolve()}"
        print_table(("what", "value", "unit"), _rows(measured), title=title)
        if measured.simulated:
            next_line(f"falconwing fly --bench {self.out}")
        else:
            next_line(f"falconwing record --port P --bench {self.out}")


@dataclass(frozen=True)
class _Setup:
    """Devices of one bench and their clock."""

    images: "ImageSource"
    port: "TrainerPort | None"
    now: Callable[[], float]  # [s]
    sleep: Callable[[float], Any]
    simulation: "SimulatedBench | None" = None

    def show_checkerboard(self, view: int) -> None:
        """Of a simulated bench: hold it there."""
        if self.simulation is not None:
            self.simulation.hold_checkerboard(view)

    def is_over(self) -> bool:
        """Whether a video file has ended."""
        health = getattr(self.images, "health", None)
        return health is not None and not health.alive and "over" in health.trouble

    def show_led(self) -> None:
        """Have the camera look at the LED."""
        if self.simulation is not None:
            self.simulation.hold_checkerboard(-1)
            return
        print(
            "hold the camera still above the LED on pin 13 of the board, the LED in the middle of"
            " the image; radio off, propeller off; then press Enter ",
            end="", file=sys.stderr, flush=True,
        )  # fmt: skip
        if not sys.stdin.readline():
            raise InputError("bench: expected Enter at the keyboard; run it at a terminal")


def _open_simulated(stack: ExitStack, port_name: str) -> _Setup:
    """A simulated bench in virtual time."""
    from falconwing_kit.tools.bridge.open_port import simulated_board
    from falconwing_kit.tools.devices.simulated_bench import SimulatedBench
    from falconwing_kit.trainer_port.port import TrainerPort

    board = simulated_board(port_name or "sim-python")
    bench = SimulatedBench(board)
    stack.callback(bench.close)
    port = None
    if port_name:
        port = TrainerPort(board, now=bench.now, what=f"SIMULATED board, {board.kind}")
        port.wait_ready(sleep=bench.sleep)
    return _Setup(bench, port, bench.now, bench.sleep, bench)


def _photo_views(
    folder: Path, pattern: tuple[int, int], progress: Callable[[], None]
) -> tuple[list[Array], tuple[int, int]]:
    """Corners in the photos of a folder that show the whole checkerboard, and their size."""
    from falconwing_kit.tools.devices.lens import find_corners
    from falconwing_kit.vision.images import read_image

    views, size = [], (0, 0)
    for path in sorted(each for each in folder.iterdir() if each.suffix.lower() in PHOTO_ENDINGS):
        pixels = read_image(path)
        if pixels is None:
            continue
        if size not in ((0, 0), (pixels.shape[1], pixels.shape[0])):
            raise InputError(
                f"--photos {folder}: expected photos of one size, got {size[0]} x {size[1]} and"
                f" {pixels.shape[1]} x {pixels.shape[0]} ({path.name})"
            )
        size = (pixels.shape[1], pixels.shape[0])
        corners = find_corners(pixels, pattern)
        if corners is not None:
            views.append(corners)
            progress()
    return views, size


def _rows(measured: "BenchCalibration") -> list[tuple[str, object, str]]:
    """The table."""
    rows: list[tuple[str, object, str]] = []
    if (fit := measured.lens) is not None:
        lens = fit.lens
        rows += [
            (f"lens at {lens.width_px} x {lens.height_px}: focal length",
             f"{lens.fx_px:.1f} {lens.fy_px:.1f}", f"px, +- {196 * fit.focal_error:.2f} %"),
            ("centre", f"{lens.cx_px:.1f} {lens.cy_px:.1f}", "px"),
            ("distortion k1 k2 p1 p2",
             " ".join(f"{k:.4f}" for k in (lens.k1, lens.k2, lens.p1, lens.p2)), ""),
            (f"reprojection, {fit.views} views", f"{fit.reprojection_px:.2f}", "px"),
        ]  # fmt: skip
    if (frames := measured.frames) is not None:
        rows += [
            ("frame rate", f"{frames.rate_hz:.2f}", "Hz"),
            ("jitter of arrivals", f"{1e3 * frames.jitter_s:.1f}", "ms"),
            ("lost frames", f"{100.0 * frames.lost_share:.1f}", "%"),
        ]
    if (ppm := measured.ppm) is not None:
        rows += [
            ("PPM frame", f"{ppm.frame_us:.0f}", "us"),
            ("channels at rest", " ".join(map(str, ppm.channels_us)), "us"),
            ("board's clock", f"{ppm.clock_ppm:+.0f}", "ppm"),
        ]
    if (delay := measured.latency) is not None:
        rows += [
            ("light to image", f"{1e3 * delay.camera_s:.1f}",
             f"ms, +- {1e3 * delay.error95_s:.1f}"),
            ("command to pulse", f"{1e3 * delay.pulse_s:.1f}", "ms, mean"),
            ("camera to pulse", f"{1e3 * delay.camera_to_pulse_s:.1f}", "ms, mean"),
        ]  # fmt: skip
    return rows


@contextmanager
def _progress(total: int, unit: str, quiet: bool) -> Iterator[Callable[[], None]]:
    from tqdm import tqdm

    with tqdm(total=total, unit=unit, leave=False, disable=True if quiet else None) as bar:
        yield lambda: bar.update() and None
