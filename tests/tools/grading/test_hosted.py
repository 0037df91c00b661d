"""A notebook taken alone says what is missing; the hosted one brings it along."""

import json
import subprocess
import sys
import sysconfig
import venv

import pytest

from falconwing_kit.core.checks import InputError
from falconwing_kit.tools.grading.collect import broken_cells, parse_notebook
from falconwing_kit.tools.grading.find import lab_folder, notebook_path
from falconwing_kit.tools.grading.hosted import attach_pictures, hosted_notebooks, hosted_text
from falconwing_kit.tools.grading.release import release
from falconwing_kit.tools.grading.wheel import WHEEL_NAME
from tests.labs.functions import ROOT
from tests.tools.grading.small_lab import write_small_lab

LAB = lab_folder("lab06", ROOT / "labs")
RUN = """
import json, sys
import matplotlib
matplotlib.use("agg")
from IPython.core.interactiveshell import InteractiveShell
InteractiveShell.history_manager_class = None
shell = InteractiveShell.instance()
sys.path.insert(0, "")
for cell in json.load(open(sys.argv[1], encoding="utf-8"))["cells"]:
    if cell["cell_type"] == "code":
        result = shell.run_cell("".join(cell["source"]))
        error = result.error_before_exec or result.error_in_exec
        if error is not None:
            print("ERROR", type(error).__name__, error)
"""


@pytest.fixture
def bare_python(tmp_path):
    """A Python with this one's libraries but without the kit, which is installed editable."""
    venv.create(tmp_path / "env", with_pip=False)
    folder = tmp_path / "env" / "lib" / f"python{sysconfig.get_python_version()}"
    paths = [each for each in sys.path if each.endswith("site-packages")]
    paths = list(dict.fromkeys([sysconfig.get_paths()["purelib"], *paths]))
    (folder / "site-packages" / "libraries.pth").write_text("\n".join(paths) + "\n")
    return tmp_path / "env" / "bin" / "python"


def run(python, notebook):
    """What the cells print, one after the other, in the notebook's folder."""
    program = notebook.parent.parent / "run.py"
    program.write_text(RUN)
    done = subprocess.run(
        [str(python), str(program), notebook.name], cwd=notebook.parent,
        capture_output=True, text=True, check=False, timeout=240,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    return done.stdout


def test_a_hosted_notebook_runs_in_an_empty_folder_with_the_wheel(bare_python, tmp_path):
    """Lab 6 with its solution's functions: kit installed by pip, files unpacked, checks passed."""
    hosted_notebooks([LAB], tmp_path / "out")
    notebook = tmp_path / "out" / "lab06.ipynb"
    assert {each.name for each in (tmp_path / "out").iterdir()} == {"lab06.ipynb", WHEEL_NAME}
    solved = json.loads(notebook_path(LAB, solution=True).read_text(encoding="utf-8"))
    written = {c["metadata"].get("exercise"): c["source"] for c in solved["cells"]}
    text = json.loads(notebook.read_text(encoding="utf-8"))
    exercises = [c for c in text["cells"] if "exercise" in c["metadata"]]
    for cell in exercises:
        cell["source"] = written[cell["metadata"]["exercise"]]
    notebook.write_text(json.dumps(text))
    printed = run(bare_python, notebook)
    assert "ERROR" not in printed
    assert printed.count("public checks passed") == len(exercises)
    assert (tmp_path / "out" / LAB.name / "given.py").is_file()
    installed = bare_python.parents[1] / "lib" / f"python{sysconfig.get_python_version()}"
    assert (installed / "site-packages" / "falconwing_kit" / "__init__.py").is_file()
    assert broken_cells(parse_notebook(notebook.read_bytes(), "lab06.ipynb")) == []


def test_without_wheel_and_address_one_sentence_says_what_to_upload(bare_python, tmp_path):
    """No address is published, as shipped: nothing is fetched, no link is dead."""
    hosted_notebooks([LAB], tmp_path / "out")
    (tmp_path / "out" / WHEEL_NAME).unlink()
    first = next(line for line in run(bare_python, tmp_path / "out" / "lab06.ipynb").splitlines()
                 if line.startswith("ERROR"))  # fmt: skip
    assert first.startswith(f"ERROR FileNotFoundError {WHEEL_NAME} is not beside this notebook: ")
    assert "upload it there" in first


def test_a_notebook_taken_alone_says_what_is_missing(tmp_path):
    """In one sentence, in place of a module that nobody can install."""
    release([LAB], tmp_path / "labs")
    (tmp_path / "alone").mkdir()
    notebook = tmp_path / "alone" / "lab06.ipynb"
    notebook.write_bytes(notebook_path(tmp_path / "labs" / LAB.name).read_bytes())
    printed = run(sys.executable, notebook)
    first = next(line for line in printed.splitlines() if line.startswith("ERROR"))
    assert first.startswith("ERROR FileNotFoundError given.py is not beside this notebook: ")
    assert "in the folder lab06_pose" in first and "hosted Python" in first


def test_the_address_is_the_published_one_and_nothing_else(tmp_path):
    """With an address the cell names it; one that is none is refused."""
    folder = write_small_lab(tmp_path / "labs")
    text = hosted_text(folder, repository="https://github.com/someone/kit")
    assert "'https://github.com/someone/kit'" in text and "git+" in text
    for wrong in ("github.com/someone/kit", "https://host", 'https://a/b"+evil'):
        with pytest.raises(InputError, match=r"expected https://\.\.\."):
            hosted_notebooks([folder], tmp_path / "out", repository=wrong)
    assert not (tmp_path / "out").exists()


def test_pictures_of_the_text_are_in_the_notebook(tmp_path):
    """A picture beside the lab is no file beside the hosted notebook: the cell holds it."""
    folder = write_small_lab(tmp_path / "labs")
    (folder / "points.png").write_bytes(b"picture")
    notebook = {"cells": [{"cell_type": "markdown", "source": ["A ![dot](points.png)"]}]}
    attach_pictures(notebook, folder)
    (cell,) = notebook["cells"]
    assert cell["attachments"] == {"points.png": {"image/png": "cGljdHVyZQ=="}}
    assert "](attachment:points.png)" in "".join(cell["source"])
