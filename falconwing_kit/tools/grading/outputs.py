"""Outputs of a lab: its solution notebook, run -> what each cell printed and drew, as JSON.

The site shows them below the student's cells (`manual/build.py site`). Cells of the solution itself
are left out.
"""

import json
import os
from pathlib import Path
from typing import Any

from falconwing_kit.core.checks import InputError
from falconwing_kit.core.files import atomic_write
from falconwing_kit.tools.grading.find import notebook_path

LONGEST_CELL_S = 600
_SHOWN = ("image/png", "image/gif", "text/plain")


def write_outputs(folder: Path, out: Path) -> Path:
    """Run a lab's solution in a kernel of its own and write what its cells show.

    Args:
        folder: the lab's, with both notebooks built.
        out: folder of the cache; made if it is not there.

    Returns:
        The file: source of a cell -> its outputs as in a notebook; none of an exercise.

    Raises:
        FileNotFoundError: the notebook is not built.
        InputError: a cell fails.
        ModuleNotFoundError: the extra `labs` is not installed.
    """
    from nbclient import NotebookClient
    from nbclient.exceptions import CellExecutionError
    from nbformat import reads

    path = notebook_path(folder, solution=True)
    notebook = reads(path.read_text(encoding="utf-8"), as_version=4)
    resources = {"metadata": {"path": str(folder)}}
    client = NotebookClient(notebook, timeout=LONGEST_CELL_S, resources=resources)
    try:
        client.execute(
            env={**os.environ, "MPLBACKEND": "module://matplotlib_inline.backend_inline"}
        )
    except CellExecutionError as error:
        raise InputError(
            f"{path}: expected a solution that runs to its end, got {error.ename}: {error.evalue}; "
            "run it in JupyterLab"
        ) from None
    shown = {
        cell.source: [kept for output in cell.outputs for kept in _kept(output)]
        for cell in notebook.cells
        if cell.cell_type == "code" and "exercise" not in cell.metadata
    }
    out.mkdir(parents=True, exist_ok=True)
    target = out / f"{folder.name}.json"
    with atomic_write(target, text=True) as handle:
        json.dump(shown, handle, indent=1, ensure_ascii=False, sort_keys=True)
    return target


def _kept(output: Any) -> list[dict[str, Any]]:
    """What a page can show of an output: printed text, a picture, or a value's text."""
    if output.output_type == "stream":
        return [dict(output)] if output.name == "stdout" else []
    for kind in _SHOWN:
        if kind in output.get("data", {}):
            data, said = {kind: output.data[kind]}, output.get("metadata", {}).get(kind, {})
            metadata = {kind: dict(said)} if said else {}  # words and width of a film
            return [{"output_type": "display_data", "data": data, "metadata": metadata}]
    return []
