"""Web: labs and a Pyodide folder -> a static site with JupyterLite, where nothing is installed.

OUT/index.html ...      JupyterLab in the browser; any web server can send it, no program runs there
OUT/files/lab01_sizing  notebooks and their files, as `labs release` writes them
OUT/pypi/               the kit's wheel
OUT/static/pyodide/     the browser's Python with NumPy, SciPy, Matplotlib and Pillow

What a page loads comes from the site itself; nothing is sent anywhere.
"""

import importlib.util
import json
import re
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

from falconwing_kit.core.checks import InputError
from falconwing_kit.core.files import atomic_write
from falconwing_kit.tools.grading.find import notebook_path
from falconwing_kit.tools.grading.hosted import IN_BROWSER
from falconwing_kit.tools.grading.release import release
from falconwing_kit.tools.grading.wheel import write_installed_wheel, write_kit_wheel

CORE = ("pyodide.mjs", "pyodide.asm.mjs", "pyodide.asm.wasm", "python_stdlib.zip")
LOCK = "pyodide-lock.json"
LIBRARIES = ("numpy", "scipy", "matplotlib", "pillow")
KERNEL = ("micropip", "ipython", "jedi")  # what the kernel loads, beside its own wheels
FROM_HERE = ("comm",)  # required by the kernel, in no Pyodide distribution; pure Python
DOWNLOAD = (
    "download pyodide-{version}.tar.bz2 (about 400 MB) from the releases of pyodide/pyodide on "
    "GitHub, unpack it, and name its folder pyodide by --pyodide"
)
_INSTALL = """\
# In the browser only: the kit's wheel comes from this site. The first run takes a minute.
import sys

if sys.platform == "emscripten":
    %pip install -q falconwing-kit"""
_KEEP = (
    "> **In the browser** your notebook is kept by this browser alone, on this computer. "
    "Keep a copy, and hand it in, by *File > Download*."
)


def web_site(folders: Sequence[Path], out: Path, pyodide: Path | None, salt: str = "") -> int:
    """Build the site, complete or not at all.

    Args:
        folders: of the labs, each one that runs in a browser.
        out: a new or empty folder.
        pyodide: an unpacked Pyodide distribution.
        salt: the course's key, as of `release`.

    Returns:
        The number of files.

    Raises:
        InputError: `out` is not empty, a lab does not run in a browser, the Pyodide folder is
            incomplete or of another version, or JupyterLite is not installed.
    """
    if out.is_file() or (out.is_dir() and any(out.iterdir())):
        raise InputError(f"{out}: expected a new or an empty folder; choose another")
    others = [folder.name for folder in folders if folder.name.split("_")[0] not in IN_BROWSER]
    if others:
        raise InputError(
            f"{', '.join(others)}: expected labs that run in a browser, {', '.join(IN_BROWSER)}; "
            "for these use falconwing labs hosted"
        )
    python, version = _kernel()
    kept = pyodide_files(pyodide, (*LIBRARIES, *KERNEL), python, version)
    out.parent.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(dir=out.parent, prefix=f".{out.name}.") as place:
        stage, site = Path(place) / "stage", Path(place) / "site"
        (stage / "pypi").mkdir(parents=True)
        (stage / "static" / "pyodide").mkdir(parents=True)
        for file in kept:
            shutil.copy(file, stage / "static" / "pyodide")
        write_kit_wheel(stage / "pypi", for_browser=True)
        for name in FROM_HERE:
            write_installed_wheel(name, stage / "pypi")
        release(folders, stage / "files", salt)
        for folder in folders:
            _for_browser(notebook_path(stage / "files" / folder.name))
        _write(stage / "jupyter-lite.json", json.dumps(_SETTINGS, indent=1) + "\n")
        _build(stage, site)
        if out.is_dir():
            out.rmdir()
        site.rename(out)
    return sum(path.is_file() for path in out.rglob("*"))


_SETTINGS = {
    "jupyter-lite-schema-version": 0,
    "jupyter-config-data": {
        "appName": "FalconWing labs",
        "litePluginSettings": {
            "@jupyterlite/pyodide-kernel-extension:kernel": {"disablePyPIFallback": True}
        },
    },
}


def _kernel() -> tuple[str, str]:
    """Versions of Python and Pyodide that the installed kernel works with."""
    if not importlib.util.find_spec("jupyterlite_core") or not importlib.util.find_spec(
        "jupyterlite_pyodide_kernel"
    ):
        raise InputError(
            "JupyterLite: expected jupyterlite-core and jupyterlite-pyodide-kernel, found none; "
            "pip install 'falconwing-kit[web]'"
        )
    from jupyterlite_pyodide_kernel import constants

    return constants.PYODIDE_PYTHON_VERSION, constants.PYODIDE_VERSION


def pyodide_files(
    folder: Path | None, packages: Iterable[str], python: str, version: str
) -> list[Path]:
    """The files of a Pyodide distribution that the labs need, of several hundred.

    Args:
        folder: the distribution's, unpacked.
        packages: names of packages; what they require comes along.
        python: the version of Python that the kernel expects, such as "3.14".
        version: Pyodide's, for the message.

    Raises:
        InputError: no folder is given, it is of another version, or files are missing.
    """
    get = DOWNLOAD.format(version=version)
    if folder is None:
        raise InputError(
            f"--pyodide: expected the folder of a Pyodide distribution, got none; {get}"
        )
    core = [folder / name for name in (*CORE, LOCK)]
    missing = [file.name for file in core if not file.is_file()]
    if missing:
        raise InputError(f"{folder}: expected {', '.join(missing)} in it, found none; {get}")
    lock = json.loads((folder / LOCK).read_text(encoding="utf-8"))
    found = str(lock["info"]["python"])
    if found.split(".")[:2] != python.split(".")[:2]:
        raise InputError(f"{folder}: expected a Pyodide with Python {python}, got {found}; {get}")
    wheels = [folder / name for name in _closure(lock["packages"], packages)]
    missing = [file.name for file in wheels if not file.is_file()]
    if missing:
        raise InputError(
            f"{folder}: expected {len(wheels)} wheels in it, {len(missing)} are missing such as "
            f"{missing[0]}; the package of npm has the core alone: {get}"
        )
    return [*core, *wheels]


def _closure(lock: dict[str, Any], packages: Iterable[str]) -> list[str]:
    """Files of packages and of what they require, by name."""
    by_name = {_canonical(each): record for each, record in lock.items()}
    names, left = set(), [_canonical(each) for each in packages]
    while left:
        name = left.pop()
        if name not in names and name in by_name:
            names.add(name)
            left += [_canonical(each) for each in by_name[name]["depends"]]
    return sorted(str(by_name[name]["file_name"]) for name in names)


def _canonical(name: str) -> str:
    return re.sub(r"[-_.]+", "-", name).lower()


def _for_browser(path: Path) -> None:
    """Put the cell that installs, and a note on keeping the notebook, above the first code."""
    notebook = json.loads(path.read_text(encoding="utf-8"))
    first = [cell["cell_type"] for cell in notebook["cells"]].index("code")
    note = {"cell_type": "markdown", "id": "cell-browser-note", "metadata": {}, "source": [_KEEP]}
    install: dict[str, Any] = {
        "cell_type": "code",
        "id": "cell-browser",
        "metadata": {},
        "source": _INSTALL.splitlines(keepends=True),
        "execution_count": None,
        "outputs": [],
    }
    notebook["cells"][first:first] = [note, install]
    notebook["metadata"]["kernelspec"] = {
        "display_name": "Python (Pyodide)",
        "language": "python",
        "name": "python",
    }
    _write(path, json.dumps(notebook, indent=1, ensure_ascii=False, sort_keys=True) + "\n")


def _build(stage: Path, site: Path) -> None:
    """Run JupyterLite's own builder in the stage."""
    words = ["build", "--lite-dir", str(stage), "--contents", str(stage / "files")]
    words += ["--output-dir", str(site), "--apps", "lab", "--no-sourcemaps"]
    program = "import sys; from jupyterlite_core.app import main; sys.exit(main())"
    done = subprocess.run(
        [sys.executable, "-c", program, *words],
        cwd=stage,
        capture_output=True,
        text=True,
        check=False,
    )
    if done.returncode or not (site / "lab" / "index.html").is_file():
        last = (done.stderr or done.stdout).strip().splitlines()[-3:]
        raise InputError(f"JupyterLite's build failed: {' '.join(last)}; see its requirements")


def _write(path: Path, text: str) -> None:
    with atomic_write(path, text=True) as handle:
        handle.write(text)
