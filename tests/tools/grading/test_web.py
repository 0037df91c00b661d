"""The site in the browser: what is in it, and what is said where the browser's Python is missing.

The Pyodide folder here is a stand-in with the right names; nothing runs in it.
"""

import json

import pytest

from falconwing_kit.core.checks import InputError
from falconwing_kit.tools.grading.find import lab_folder
from falconwing_kit.tools.grading.web import CORE, LOCK, pyodide_files, web_site
from tests.labs.functions import ROOT

PACKAGES = {
    "numpy": [],
    "scipy": ["numpy"],
    "matplotlib": ["Contour_Py", "numpy"],
    "contour-py": ["numpy"],
    "pillow": [],
    "micropip": [],
    "ipython": ["jedi"],
    "jedi": [],
    "pandas": ["numpy"],
}


@pytest.fixture
def pyodide(tmp_path):
    """A folder with the names of a distribution's files."""
    folder = tmp_path / "pyodide"
    folder.mkdir()
    for name in CORE:
        (folder / name).write_text("stand-in")
    record = {
        name: {"file_name": f"{name}-1-py3-none-any.whl", "depends": depends}
        for name, depends in PACKAGES.items()
    }
    lock = {"info": {"python": "3.14.2"}, "packages": record}
    (folder / LOCK).write_text(json.dumps(lock))
    for each in record.values():
        (folder / each["file_name"]).write_text("stand-in")
    return folder


def test_site_has_the_students_labs_the_kit_and_only_what_they_need(pyodide, tmp_path):
    """JupyterLite's own builder runs; no solution, no package beside those required."""
    out = tmp_path / "site"
    folders = [lab_folder(name, ROOT / "labs") for name in ("lab01", "lab02")]
    web_site(folders, out, pyodide)
    files = {path.relative_to(out).as_posix() for path in out.rglob("*") if path.is_file()}
    assert {"lab/index.html", "files/lab02_camera/data/view0.jpg"} <= files
    assert not any("solution" in name or "hidden" in name for name in files)
    wheels = {name.rsplit("/", 1)[1].split("-")[0] for name in files if "static/pyodide" in name
              and name.endswith(".whl")}  # fmt: skip
    assert wheels == {"numpy", "scipy", "matplotlib", "contour", "pillow", "micropip", "ipython",
                      "jedi"}  # fmt: skip
    assert set(json.loads((out / "pypi" / "all.json").read_text())) == {"falconwing-kit", "comm"}
    settings = json.loads((out / "jupyter-lite.json").read_text())["jupyter-config-data"]
    kernel = settings["litePluginSettings"]["@jupyterlite/pyodide-kernel-extension:kernel"]
    assert kernel["disablePyPIFallback"] and kernel["pyodideUrl"].startswith("./static/pyodide/")
    notebook = json.loads((out / "files/lab01_sizing/lab01.ipynb").read_text(encoding="utf-8"))
    code = ["".join(c["source"]) for c in notebook["cells"] if c["cell_type"] == "code"]
    assert "%pip install -q falconwing-kit" in code[0] and "import given" in code[1]
    assert list(tmp_path.glob(".site*")) == []


@pytest.mark.parametrize(
    "spoil, words",
    [
        (
            lambda folder: (folder / "scipy-1-py3-none-any.whl").unlink(),
            "1 are missing such as scipy",
        ),
        (lambda folder: (folder / CORE[0]).unlink(), f"expected {CORE[0]} in it"),
        (
            lambda folder: (folder / LOCK).write_text(
                (folder / LOCK).read_text().replace("3.14", "3.12")
            ),
            r"expected a Pyodide with Python 3\.14, got 3\.12\.2",
        ),
    ],
)
def test_an_incomplete_folder_is_refused_with_what_to_download(pyodide, spoil, words):
    """By hand: each names the fault, the file to download and the option."""
    spoil(pyodide)
    with pytest.raises(InputError, match=words) as refusal:
        pyodide_files(pyodide, ("scipy", "matplotlib"), "3.14", "314.0.6")
    assert "pyodide-314.0.6.tar.bz2" in str(refusal.value) and "--pyodide" in str(refusal.value)


def test_no_folder_and_other_labs_are_refused(pyodide, tmp_path):
    """Without a folder: what to download; a lab that needs torch: the hosted notebook."""
    lab = lab_folder("lab01", ROOT / "labs")
    with pytest.raises(InputError, match=r"got none; download pyodide-[\d.]+\.tar\.bz2"):
        web_site([lab], tmp_path / "site", None)
    with pytest.raises(InputError, match=r"lab08_imitation: .*use falconwing labs hosted"):
        web_site([lab_folder("lab08", ROOT / "labs")], tmp_path / "site", pyodide)
    assert not (tmp_path / "site").exists()
