"""Sandbox side: a student's notebook -> the pictures of its cells, after a run from top to bottom.

This file runs by its path. Kernel, notebook and this program share a sandbox without network or
home, so the output is untrusted: it is shown to a person and gives no points.
"""

import json
import os
import shutil
import sys
import time
from contextlib import suppress
from pathlib import Path
from typing import Any

WORK, PLACE = Path(sys.argv[2] if len(sys.argv) > 2 else "."), Path("/tmp/lab")
LIMITS = {"RLIMIT_AS": 12 << 30, "RLIMIT_FSIZE": 64 << 20, "RLIMIT_CORE": 0}
CELL_SECONDS, SECONDS = 120.0, 300.0  # for a cell, for all


def main() -> None:
    """Run `notebook.ipynb` in a copy of its folder and write the pictures as JSON to stdout."""
    import resource  # Linux and macOS only; the file's path is read on other systems too

    answers = os.dup(1)
    os.dup2(os.open(os.devnull, os.O_RDWR), 1)
    for which, limit in LIMITS.items():
        resource.setrlimit(getattr(resource, which), (limit, limit))
    packages = sorted(str(path) for path in Path("/sandbox").glob("site*"))
    sys.path[:0] = ["/sandbox/kit", *packages]
    os.environ |= {
        "PYTHONPATH": ":".join(["/sandbox/kit", *packages]),
        "PYTHONDONTWRITEBYTECODE": "1",
    }
    shutil.copytree(WORK, PLACE)
    ran = run(PLACE / "notebook.ipynb")
    with os.fdopen(answers, "wb") as out:
        out.write(json.dumps(ran).encode())


def run(path: Path) -> dict[str, Any]:
    """Metadata and pictures of the notebook's cells after a run."""
    import nbclient
    import nbformat

    notebook = nbformat.read(path, as_version=4)
    for cell in notebook.cells:
        if cell.cell_type == "code":
            cell.outputs = []
    end = time.monotonic() + SECONDS
    client = nbclient.NotebookClient(
        notebook,
        timeout_func=lambda cell: max(1.0, min(CELL_SECONDS, end - time.monotonic())),
        kernel_name="python3",
        allow_errors=True,
        resources={"metadata": {"path": str(PLACE)}},
    )
    # cells before a timeout or a crash keep their outputs
    with suppress(TimeoutError, nbclient.exceptions.DeadKernelError):
        client.execute()
    return {
        "cells": [{"metadata": cell.metadata, "outputs": pictures(cell)} for cell in notebook.cells]
    }


def pictures(cell: Any) -> list[dict[str, Any]]:
    """A cell's PNG outputs only."""
    found = [output.get("data", {}).get("image/png") for output in cell.get("outputs", [])]
    return [{"data": {"image/png": image}} for image in found if image]


if __name__ == "__main__":
    main()
