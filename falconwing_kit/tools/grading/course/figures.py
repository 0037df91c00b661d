"""Figures: a submitted notebook -> the pictures of its cells, from a sandboxed run or as stored.

The kernel runs in a sandbox with the kit and the students' libraries, without network, home, other
submissions, solutions or hidden cases. Its output is untrusted and only shown to a person.
"""

import base64
import binascii
import importlib.util
import json
import os
import signal
import struct
import subprocess
import tempfile
import threading
import time
from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any

import falconwing_kit
from falconwing_kit.core.files import shipped_path
from falconwing_kit.tools.grading.course import notebook_runner
from falconwing_kit.tools.grading.sandbox import limits, runtime

NEEDED = ("nbclient", "ipykernel", "matplotlib", "numpy")
PROCESSES, MEMORY, SECONDS = 160, 3 << 30, 400.0  # limits of a run: with threads, bytes, s
MAX_OUT, MAX_PNG, MAX_SIDE, MAX_FIGURES = 24 << 20, 2 << 20, 4000, 4  # bytes, bytes, px, per cell
_PNG = b"\x89PNG\r\n\x1a\n"


def run_notebook(
    data: bytes, lab_files: Mapping[Path, str], constants: Mapping[str, float]
) -> dict[str, Any] | None:
    """Run a notebook in a sandbox.

    Args:
        data: the notebook's bytes, untrusted.
        lab_files: files beside it: path on the disk, name in the sandbox.
        constants: of the course.

    Returns:
        The executed notebook in the form that `figures_in` reads; None if it did not run.

    Raises:
        InputError: bubblewrap or a library is missing.
    """
    with tempfile.TemporaryFile() as notebook, tempfile.TemporaryFile() as cohort:
        notebook.write(data)
        cohort.write(json.dumps(dict(constants)).encode())
        for handle in (notebook, cohort):
            handle.seek(0)
        work = runtime.WORK
        files = {notebook.fileno(): work / "notebook.ipynb", cohort.fileno(): work / "cohort.json"}
        own = _libraries() | {path: work / name for path, name in lab_files.items()}
        script = Path(notebook_runner.__file__).name
        box = runtime.sandbox_command(("numpy",), own, files, script, processes=True)
        group = limits.make_group(PROCESSES, MEMORY)
        become, out = limits.make_preexec(group, box.staged), subprocess.PIPE
        process = subprocess.Popen(
            box.words,
            stdin=subprocess.DEVNULL,
            stdout=out,
            stderr=subprocess.DEVNULL,
            env={},
            preexec_fn=become,
            pass_fds=(*files, *box.descriptors),
            start_new_session=True,
        )
        for descriptor in box.descriptors:
            os.close(descriptor)
    return _read_reply(process, group)


def missing_for_running() -> list[str]:
    """Missing libraries without which notebooks cannot run."""
    return [name for name in NEEDED if importlib.util.find_spec(name) is None]


def _libraries() -> dict[Path, Path]:
    """The kit and the library folders that a notebook needs: path outside, path inside."""
    kit = Path(falconwing_kit.__file__).resolve().parent
    hardware = shipped_path("hardware/airframe_umx.toml", "install the kit again").parent
    places = dict.fromkeys(
        Path(str(spec.origin)).parents[1] for spec in map(importlib.util.find_spec, NEEDED) if spec
    )
    own = {
        place.resolve(): runtime.SANDBOX / f"site{number}" for number, place in enumerate(places)
    }
    own |= {kit: runtime.SANDBOX / "kit" / kit.name, hardware: runtime.SANDBOX / "kit" / "hardware"}
    script = Path(notebook_runner.__file__)
    return own | {script: runtime.SANDBOX / script.name}


def _read_reply(
    process: "subprocess.Popen[bytes]", group: limits.ControlGroup
) -> dict[str, Any] | None:
    """The sandbox's reply within the size and time limits; then all its processes end."""

    def end() -> None:
        with suppress(ProcessLookupError, PermissionError):
            os.killpg(process.pid, signal.SIGKILL)

    over, last = threading.Event(), time.monotonic() + SECONDS
    bound = "memory" in limits.controllers()

    def watch() -> None:
        """End the run at its limits; the kernel does so for the memory of a control group."""
        while not over.wait(0.05):
            full = not bound and limits.resident_bytes(process.pid) > MEMORY
            if full or time.monotonic() > last:
                end()
                return

    threading.Thread(target=watch, daemon=True).start()
    try:
        reply = process.stdout.read(MAX_OUT + 1)  # type: ignore[union-attr]
    finally:
        over.set()
        end()
        process.communicate()
        group.remove()
    if len(reply) > MAX_OUT:
        return None
    with suppress(ValueError, RecursionError):
        content = json.loads(reply)
        return content if isinstance(content, dict) else None
    return None


def figures_in(content: Any, name: str = "") -> list[str]:
    """The pictures of a notebook's cells.

    Args:
        content: a notebook's JSON, or a result of `run_notebook`; untrusted.
        name: of a figure's cell; empty for all cells.

    Returns:
        PNG files in base64, limited in size and number.
    """
    cells = content.get("cells") if isinstance(content, dict) else None
    found: list[str] = []
    for cell in cells if isinstance(cells, list) else []:
        metadata, outputs = (
            cell.get(key) if isinstance(cell, dict) else None for key in ("metadata", "outputs")
        )
        if name and not (isinstance(metadata, dict) and metadata.get("figure") == name):
            continue
        for output in outputs if isinstance(outputs, list) else []:
            image = output.get("data") if isinstance(output, dict) else None
            text = image.get("image/png") if isinstance(image, dict) else None
            text = "".join(map(str, text)) if isinstance(text, list) else text
            clean = _clean_png(text) if isinstance(text, str) else ""
            found += [clean] if clean else []
    return found[:MAX_FIGURES]


def _clean_png(text: str) -> str:
    """The picture in base64 again if it is a valid PNG of acceptable size; else empty."""
    if len(text) > 2 * MAX_PNG:
        return ""
    try:
        data = base64.b64decode("".join(text.split()), validate=True)
        width, height = struct.unpack(">II", data[16:24])
    except (binascii.Error, ValueError, struct.error):
        return ""
    fits = (
        data.startswith(_PNG)
        and len(data) <= MAX_PNG
        and 0 < width <= MAX_SIDE
        and 0 < height <= MAX_SIDE
    )
    return base64.b64encode(data).decode("ascii") if fits else ""
