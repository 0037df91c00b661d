"""Inside the box: a student's notebook -> the same notebook run from top to bottom, of which only
pictures come out.

This file runs alone, by its path. Kernel, notebook and this program share a box without network or
home, so nothing that comes out is believed: it is for a person to look at, and gives no points.
"""

import json
import os
import resource
import shutil
import sys
import time
from contextlib import suppress
from pathlib import Path
from typing import Any

DESK, PLACE = Path(sys.argv[2] if len(sys.argv) > 2 else "."), Path("/tmp/lab")
LIMITS = {resource.RLIMIT_AS: 12 << 30, resource.RLIMIT_FSIZE: 64 << 20, resource.RLIMIT_CORE: 0}
CELL_SECONDS, SECONDS = 120.0, 300.0  # for a cell, for all


def main() -> None:
    """Run `notebook.ipynb` of the desk in a copy of it, and say what its cells drew."""
    answers = os.dup(1)
    os.dup2(os.open(os.devnull, os.O_RDWR), 1)
    for which, limit in LIMITS.items():
        resource.setrlimit(which, (limit, limit))
    packages = sorted(str(path) for path in Path("/box").glob("site*"))
    sys.path[:0] = ["/box/kit", *packages]
    os.environ |= {"PYTHONPATH": ":".join(["/box/kit", *packages]), "PYTHONDONTWRITEBYTECODE": "1"}
    shutil.copytree(DESK, PLACE)
    ran = run(PLACE / "notebook.ipynb")
    with os.fdopen(answers, "wb") as out:
        out.write(json.dumps(ran).encode())


def run(path: Path) -> dict[str, Any]:
    """The notebook's cells after running it: their metadata and their pictures."""
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
    with suppress(
        TimeoutError, nbclient.exceptions.DeadKernelError
    ):  # what was drawn before it ended is there
        client.execute()
    return {
        "cells": [{"metadata": cell.metadata, "outputs": pictures(cell)} for cell in notebook.cells]
    }


def pictures(cell: Any) -> list[dict[str, Any]]:
    """A cell's outputs that are PNG images, with nothing else in them."""
    found = [output.get("data", {}).get("image/png") for output in cell.get("outputs", [])]
    return [{"data": {"image/png": image}} for image in found if image]


if __name__ == "__main__":
    main()
