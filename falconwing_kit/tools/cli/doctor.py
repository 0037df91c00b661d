"""falconwing doctor: check the installation and suggest fixes; run the aircraft's checklists.

A capability "works" only if it was just tried with success.
"""

import importlib
import os
import platform
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from falconwing_kit.core.checks import InputError
from falconwing_kit.tools.cli.show import json_fields, next_line, print_json, print_table
from falconwing_kit.tools.linux import linux_advice

Need = Literal["demo", "now", "later"]
AVR = "make gcc gcc-avr avr-libc arduino-core-avr libsimavr-dev"
REINSTALL = "delete .venv and run python3 start.py doctor, which installs it again"


@dataclass(frozen=True)
class SystemCheck:
    """One capability and how to check it."""

    capability: str
    need: Need  # for the demo; for a verb or a lab; for an optional part
    attempt: Callable[[], str]  # returns what was found, raises if it does not work
    advice: str
    needs_linux: bool = False  # the advice names the way there


@dataclass(frozen=True)
class SystemCheckResult:
    """Result of one check."""

    capability: str
    status: Literal["works", "missing", "not needed yet"]
    needed_by_demo: bool
    detail: str
    advice: str  # the fix; empty if it works


@dataclass(frozen=True)
class Doctor:
    """Check the installation and suggest fixes, or work through a checklist of the aircraft.

    Exit code 0 if everything that the demo needs works, or no step of the checklist failed, else 1.
    """

    json: bool = False
    """print JSON instead of a table"""
    bench: bool = False
    """interactive bench-test checklist, propeller off; without a terminal, print it"""
    preflight: bool = False
    """interactive preflight checklist"""
    port: str = ""
    """serial port of the board for automatic checklist steps; sim is a SIMULATED one"""
    camera: str = ""
    """camera for automatic checklist steps: number, path or video file; sim is SIMULATED"""
    print_mm: float | None = None
    """measured length of a check line of 100 mm on a page of falconwing print; with --bench, which
    asks for it at a terminal
    """
    out: Path | None = None
    """folder for the dated record of the checklist"""

    def run(self) -> int:
        """Try every capability and print the results, or work through a checklist.

        Returns:
            0 if everything that the demo needs works, or no step failed, else 1.

        Raises:
            InputError: options contradict each other, or the record cannot be written.
        """
        if self.bench or self.preflight:
            return self._walk()
        if self.print_mm is not None:
            raise InputError("--print-mm: expected --bench with it, got none; add --bench")
        if self.port or self.camera or self.out is not None:
            raise InputError(
                "--port, --camera, --out: expected --bench or --preflight with them, got neither; "
                "add one of these"
            )
        findings = [examine(check) for check in CHECKS]
        demo_works = all(
            finding.status == "works" for finding in findings if finding.needed_by_demo
        )
        if self.json:
            print_json(
                {"demo_works": demo_works, "findings": [json_fields(each) for each in findings]}
            )
            return 0 if demo_works else 1
        print_table(
            ("capability", "status", "found"),
            [(f.capability, f.status, f.detail) for f in findings],
        )
        broken = [finding for finding in findings if finding.advice]
        if broken:
            print()
            print_table(("to fix", "do this"), [(f.capability, f.advice) for f in broken])
        next_line(
            "falconwing demo"
            if demo_works
            else "fix the first missing capability above, then falconwing doctor"
        )
        return 0 if demo_works else 1

    def _walk(self) -> int:
        from falconwing_kit.tools.cli.checklist import ChecklistDevices, walk
        from falconwing_kit.tools.hardware.checklists import load_checklists

        if self.bench and self.preflight:
            raise InputError(
                "--bench, --preflight: expected one of them, got both; start with the bench test"
            )
        lists = load_checklists()
        devices = ChecklistDevices(self.port, self.camera)
        if self.bench:
            return walk(lists.bench, devices, self.out, self.json, True, self.print_mm)
        if self.print_mm is not None:
            raise InputError("--print-mm: expected --bench with it, got --preflight; leave it out")
        return walk(lists.preflight, devices, self.out, self.json)


def examine(check: SystemCheck) -> SystemCheckResult:
    """Try one capability; an optional one is "not needed yet" rather than "missing"."""
    try:
        return SystemCheckResult(
            check.capability, "works", check.need == "demo", check.attempt(), ""
        )
    except Exception as error:  # any error is the result
        text = (
            f"{error.name} is not installed"
            if isinstance(error, ModuleNotFoundError)
            else str(error)
        )
        lines = text.splitlines() or [type(error).__name__]
        status: Literal["missing", "not needed yet"] = (
            "not needed yet" if check.need == "later" else "missing"
        )
        advice = linux_advice(check.advice) if check.needs_linux else check.advice
        return SystemCheckResult(check.capability, status, check.need == "demo", lines[0], advice)


def _python() -> str:
    major, minor, _ = platform.python_version_tuple()
    if (int(major), int(minor)) < (3, 11):
        raise RuntimeError(f"expected 3.11 or newer, got {platform.python_version()}")
    system = f"{platform.system()} {platform.machine()}"
    return f"{platform.python_version()}, {system}, {os.cpu_count()} cores"


def _folder() -> str:
    with tempfile.NamedTemporaryFile(dir=".") as file:
        file.write(b"falconwing")
        file.flush()
        if Path(file.name).stat().st_size != len(b"falconwing"):
            raise OSError("a file written here does not have its size")
    free_mb = shutil.disk_usage(".").free / 1e6
    if free_mb < 200.0:
        raise OSError(f"expected 200 MB for figures and logs, got {free_mb:.0f} MB free")
    return f"wrote a file in this folder; {free_mb / 1e3:.1f} GB free"


def _arrays() -> str:
    import numpy as np
    import scipy
    from scipy.optimize import least_squares

    x = np.linspace(0.0, 1.0, 20)
    slope, offset = least_squares(lambda k: k[0] * x + k[1] - (3.0 * x + 2.0), [0.0, 0.0]).x
    if abs(slope - 3.0) + abs(offset - 2.0) > 1e-6:
        raise RuntimeError(f"fitted a line of slope 3 and offset 2 as {slope:.3g} and {offset:.3g}")
    return f"numpy {np.__version__}, scipy {scipy.__version__}; fitted a line"


def _airframe() -> str:
    from falconwing_kit.aircraft.airframe import load_airframe
    from falconwing_kit.tools.hardware.cameras import SHIPPED, load_camera
    from falconwing_kit.tools.hardware.checklists import load_checklists
    from falconwing_kit.tools.hardware.parts import load_parts

    airframe, parts = load_airframe(), load_parts()
    cameras, lists = [load_camera(name) for name in SHIPPED], load_checklists()
    steps = len(lists.bench.steps) + len(lists.preflight.steps)
    whole = f"{airframe.name}, {airframe.mass * 1e3:.0f} g"
    return f"read {whole}, {len(parts)} parts, {len(cameras)} cameras, {steps} steps of checklists"


def _plots() -> str:
    import io

    import matplotlib
    from matplotlib.figure import Figure

    picture = io.BytesIO()
    figure = Figure()
    figure.subplots().plot([0, 1])
    figure.savefig(picture, format="png")
    if not picture.getvalue().startswith(b"\x89PNG"):
        raise RuntimeError("the figure is not a PNG")
    return f"matplotlib {matplotlib.__version__}; drew a figure"


def _compiler() -> str:
    import numba

    total = numba.njit(lambda n: n * (n + 1) // 2)
    if total(10) != 55:
        raise RuntimeError("compiled code computes a wrong sum")
    return f"numba {numba.__version__}; compiled and ran a function"


def _log() -> str:
    import io

    import mcap
    from mcap.reader import make_reader
    from mcap.writer import Writer

    file = io.BytesIO()
    writer = Writer(file)
    writer.start()
    channel = writer.register_channel(topic="check", message_encoding="json", schema_id=0)
    writer.add_message(channel_id=channel, log_time=1, publish_time=1, data=b"{}")
    writer.finish()
    file.seek(0)
    if [message.data for _, _, message in make_reader(file).iter_messages()] != [b"{}"]:
        raise RuntimeError("a log does not read back as written")
    return f"mcap {mcap.__version__}; wrote and read a log"


def _control() -> str:
    import control

    gain, _, _ = control.lqr(
        [[0.0, 1.0], [0.0, 0.0]], [[0.0], [1.0]], [[1.0, 0.0], [0.0, 1.0]], [[1.0]]
    )
    # the double integrator's gains by hand: 1 and sqrt(3)
    if abs(gain[0, 0] - 1.0) + abs(gain[0, 1] - 3.0**0.5) > 1e-6:
        raise RuntimeError(f"the double integrator's LQR gains are 1 and 1.732, got {gain}")
    return f"control {control.__version__}; designed an LQR"


def _labs() -> str:
    importlib.import_module("jupyterlab")
    return f"jupyterlab {_output([sys.executable, '-m', 'jupyterlab', '--version'])} answers"


def _serial() -> str:
    from falconwing_kit.trainer_port.usb import find_boards

    boards = find_boards()  # most likely first
    if not boards:
        raise RuntimeError("no board on a USB serial port found")
    if not boards[0].likely:
        raise RuntimeError(
            f"found {boards[0].path}, which does not look like a Mega 2560: {boards[0].what}"
        )
    if not boards[0].may_open:
        raise RuntimeError(f"found {boards[0].path}, but you may not open it")
    return f"found {boards[0].path}, {boards[0].what}; not opened, that could restart the board"


def _camera() -> str:
    os.environ.setdefault("OPENCV_LOG_LEVEL", "OFF")  # no warning for a missing camera
    import cv2

    names = (
        sorted(str(path) for path in Path("/dev").glob("video*"))
        if sys.platform == "linux"
        else ["0"]
    )
    for name in names:
        camera = cv2.VideoCapture(int(name) if name.isdigit() else name)
        found, image = camera.read()
        camera.release()
        if found:
            return f"camera {name} gave an image of {image.shape[1]} x {image.shape[0]}"
    raise RuntimeError("no camera gave an image")


def _torch() -> str:
    import torch

    if float((torch.ones(2, 2) @ torch.ones(2, 2)).sum()) != 8.0:
        raise RuntimeError("a product of matrices is wrong")
    return f"torch {torch.__version__}; multiplied matrices on the CPU"


def _rendering() -> str:
    import numpy as np

    from falconwing_kit.scene import GaussianScene, PinholeCamera, nose_camera_pose, render

    one = np.ones((1, 3), np.float32)
    ahead, upright = np.array([[2, 0, 0]], np.float32), np.array([[1, 0, 0, 0]], np.float32)
    white = GaussianScene(ahead, upright, 0.5 * one, np.array([0.9], np.float32), 1.77 * one[None])
    frame = render(
        white,
        PinholeCamera.from_fov_deg(9, 9, 60.0),
        nose_camera_pose((0.0, 0.0, 0.0), 0.0, 0.0, 0.0),
    )
    if not 0.88 < float(frame.rgb[4, 4].min()) < 0.91:
        raise RuntimeError("a white splat of opacity 0.9 has another colour")
    return "drew a Gaussian on the CPU"


def _page() -> str:
    import socket

    import websockets

    with socket.create_server(("127.0.0.1", 0)):
        return f"websockets {websockets.__version__}; this machine serves pages to itself"


def _gpu() -> str:
    from falconwing_kit.scene.gsplat_backend import probe_gsplat

    try:
        probe_gsplat()
    except InputError as error:
        raise RuntimeError(str(error).split(";")[0]) from None
    return "gsplat drew a Gaussian on the GPU"


def _sandbox() -> str:
    _need_linux()
    _output(["bwrap", "--ro-bind", "/", "/", "--unshare-all", "--die-with-parent", "true"])
    return f"{_output(['bwrap', '--version'])} ran a program without network"


def _avr() -> str:
    from falconwing_kit.tools.bridge.build import missing_tools
    from falconwing_kit.tools.bridge.simulated_board import SimulatedBoard
    from falconwing_kit.trainer_port.port import TrainerPort

    _need_linux()
    missing = missing_tools()
    if missing:
        raise RuntimeError(f"not installed: {', '.join(missing)}")
    board = SimulatedBoard()
    try:
        port = TrainerPort(board, now=lambda: board.t)
        status = port.wait_ready(sleep=lambda seconds: board.run_until(board.t + seconds))
    finally:
        board.close()
    return f"built the firmware; in a simulated chip it starts in state {status.state}"


def _need_linux() -> None:
    if sys.platform != "linux":
        raise RuntimeError(f"needs Linux, this is {platform.system()}")


def _output(command: list[str]) -> str:
    """First line of a program's output; raises if it is missing or fails."""
    if shutil.which(command[0]) is None:
        raise RuntimeError(f"{command[0]} is not installed")
    done = subprocess.run(command, capture_output=True, text=True, timeout=60, check=False)
    if done.returncode != 0:
        raise RuntimeError((done.stderr.strip() or f"exit code {done.returncode}").splitlines()[-1])
    return (done.stdout.strip() or done.stderr.strip() or "no output").splitlines()[0]


CHECKS: tuple[SystemCheck, ...] = (
    SystemCheck(
        "Python",
        "demo",
        _python,
        "install Python 3.11 or newer, delete .venv and run start.py with it",
    ),
    SystemCheck(
        "this folder",
        "demo",
        _folder,
        "use a writable folder on a disk with free space",
    ),
    SystemCheck("arrays and fits", "demo", _arrays, REINSTALL),
    SystemCheck(
        "airframe data",
        "demo",
        _airframe,
        "run from a checkout of the kit that has its hardware folder",
    ),
    SystemCheck("figures", "demo", _plots, REINSTALL),
    SystemCheck("fast roll-outs", "demo", _compiler, REINSTALL),
    SystemCheck("rendering", "demo", _rendering, REINSTALL),
    SystemCheck("live page", "demo", _page, REINSTALL),
    SystemCheck("flight logs", "demo", _log, REINSTALL),
    SystemCheck("control design", "demo", _control, REINSTALL),
    SystemCheck("labs", "later", _labs, "python3 start.py install labs"),
    SystemCheck(
        "finding the board", "now", _serial, "connect it; falconwing find-port lists the ports"
    ),
    SystemCheck("camera", "later", _camera, "connect the camera"),
    SystemCheck("reference renderer", "later", _torch, "python3 start.py install labs"),
    SystemCheck(
        "rendering on a GPU",
        "later",
        _gpu,
        "needs an NVIDIA GPU, a CUDA build of torch, and gsplat",
    ),
    SystemCheck(
        "grading sandbox", "later", _sandbox, "Debian or Ubuntu: apt install bubblewrap", True
    ),
    SystemCheck(
        "firmware tools",
        "now",
        _avr,
        f"Debian or Ubuntu: apt install {AVR}; without, --port sim-python is plain Python",
        True,
    ),
)
