"""Run a lab's notebook as a browser's Python would: a program for a process of its own.

    python tests/labs/no_install.py labs/lab01_sizing/solution/lab01.ipynb

What pyproject.toml does not require on Emscripten cannot be imported, nor torch, viser and Unix's
modules; no thread, process or compiler starts, and `sys.platform` says emscripten to the kit. This
is no browser: NumPy, SciPy and Matplotlib are this machine's.

Prints one JSON object: `cpu_s` of all cells, `errors` by cell, `printed`, `figures` and the
third-party packages that were `imported`.
"""

import contextlib
import io
import json
import os
import re
import site
import subprocess
import sys
import threading
import time
import tomllib
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[2]
UNIX = ("fcntl", "grp", "pty", "pwd", "resource", "termios")
IMPORT_NAMES = {
    "opencv-python-headless": "cv2",
    "pyserial": "serial",
    "pyyaml": "yaml",
    "tomli-w": "tomli_w",
}


def left_out() -> list[str]:
    """Modules of the requirements that pyproject.toml leaves out on Emscripten."""
    record = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))
    names = [
        re.match(r"[\w.-]+", each)[0]
        for each in record["project"]["dependencies"]
        if "sys_platform != 'emscripten'" in each
    ]
    return [IMPORT_NAMES.get(name, name) for name in names]


def block() -> None:
    """Make this process as poor as a browser's Python; loads what a browser has first."""
    import matplotlib

    matplotlib.use("agg")
    import matplotlib.pyplot
    import scipy.optimize  # noqa: F401  (its own start looks at the platform)
    from IPython.core.interactiveshell import InteractiveShell  # noqa: F401

    for name in (*left_out(), "torch", "viser", "llvmlite", *UNIX):
        sys.modules[name] = None
        for loaded in [each for each in sys.modules if each.startswith(f"{name}.")]:
            sys.modules[loaded] = None

    def refuse(*words: Any, **more: Any) -> None:
        raise RuntimeError("a browser's Python starts no thread and no process")

    site.USER_BASE = None  # asked again, on a platform where there is none
    threading.Thread.start = subprocess.Popen.__init__ = os.fork = refuse
    sys.platform = "emscripten"


def run_cells(notebook: Path) -> dict[str, Any]:
    """Run the code cells in the lab's folder, all of them, also after one that failed."""
    from IPython.core.interactiveshell import InteractiveShell
    from matplotlib import pyplot

    lab = notebook.parent.parent if notebook.parent.name == "solution" else notebook.parent
    os.chdir(lab)
    sys.path.insert(0, str(lab))
    InteractiveShell.history_manager_class = None
    shell = InteractiveShell.instance()
    cells = json.loads(notebook.read_text(encoding="utf-8"))["cells"]
    before, errors, figures = set(sys.modules), {}, 0
    start, printed = time.process_time(), io.StringIO()
    for number, cell in enumerate(cells):
        if cell["cell_type"] != "code":
            continue
        with contextlib.redirect_stdout(printed):
            result = shell.run_cell("".join(cell["source"]))
        error = result.error_before_exec or result.error_in_exec
        if error is not None:
            errors[number] = f"{type(error).__name__}: {error}"
        for figure in pyplot.get_fignums():
            pyplot.figure(figure).savefig(io.BytesIO())
            figures += 1
        pyplot.close("all")
    new = {name.split(".")[0] for name in set(sys.modules) - before if sys.modules[name]}
    return {
        "cpu_s": time.process_time() - start,
        "errors": errors,
        "figures": figures,
        "printed": printed.getvalue(),
        "imported": sorted(new - set(sys.stdlib_module_names) - {"given", "checks"}),
    }


def run_notebook_without_install(notebook: Path) -> dict[str, Any]:
    """The same in a process of its own."""
    done = subprocess.run(
        [sys.executable, str(Path(__file__).resolve()), str(notebook)],
        env=os.environ | {"PYTHONPATH": str(ROOT), "OMP_NUM_THREADS": "1"},
        capture_output=True, text=True, check=False, timeout=600,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout.splitlines()[-1])


if __name__ == "__main__":
    block()
    print(json.dumps(run_cells(Path(sys.argv[1]).resolve())))
