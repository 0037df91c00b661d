"""Run a lab's notebook top to bottom in a fresh kernel, in the lab's folder."""

import os
from pathlib import Path
from types import SimpleNamespace

import nbformat
from nbclient import NotebookClient

ROOT = Path(__file__).resolve().parents[2]


def run_notebook(text: str, folder: Path, *, go_on: bool = False) -> list[SimpleNamespace]:
    """The notebook's cells after it ran.

    Args:
        text: of the notebook's file.
        folder: the lab's, where it runs.
        go_on: run the cells after one that failed too.

    Returns:
        Code cells in order: `kind` and `name` as in the lab's source, `printed`, `pictures` (how
        many), `films` (size and words of each), `errors` (the names of what was raised).
    """
    notebook = nbformat.reads(text, as_version=4)
    client = NotebookClient(
        notebook,
        timeout=280,
        allow_errors=go_on,
        resources={"metadata": {"path": str(folder)}},
    )
    threads = {
        "OMP_NUM_THREADS": "1",
        "OPENBLAS_NUM_THREADS": "1",
        "MPLBACKEND": "module://matplotlib_inline.backend_inline",
    }
    client.execute(env=os.environ | threads | {"PYTHONPATH": str(ROOT)})
    return [_seen(cell) for cell in notebook.cells if cell.cell_type == "code"]


def _seen(cell: nbformat.NotebookNode) -> SimpleNamespace:
    kinds = [kind for kind in ("exercise", "check", "figure") if kind in cell.metadata]
    outputs = cell.outputs
    return SimpleNamespace(
        kind=kinds[0] if kinds else "",
        name=cell.metadata[kinds[0]] if kinds else "",
        source=cell.source,
        printed="".join(
            each.text for each in outputs if each.output_type == "stream" and each.name == "stdout"
        ),
        complained="".join(
            each.text for each in outputs if each.output_type == "stream" and each.name == "stderr"
        ),
        films=[
            (
                len(each.data["image/gif"]) * 3 // 4,
                each.metadata.get("image/gif", {}).get("alt", ""),
            )
            for each in outputs
            if "image/gif" in each.get("data", {})
        ],
        pictures=sum("image/png" in each.get("data", {}) for each in outputs),
        errors=[each.ename for each in outputs if each.output_type == "error"],
    )
