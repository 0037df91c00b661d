"""A student's parts: what passes its checks is theirs, the rest the kit's; it always loads."""

import json
import math
from pathlib import Path

import numpy as np
import pytest

from falconwing_kit.core.checks import InputError
from falconwing_kit.tools.cli.main import main
from falconwing_kit.tools.grading.find import lab_folders, load_checks, notebook_path
from falconwing_kit.tools.grading.mine import PARTS, collect_mine, load_parts
from falconwing_kit.tools.grading.release import release

LABS = Path(__file__).resolve().parents[3] / "labs"


def student(tmp_path, lab, changes=None, *, solved=True):
    """A released lab whose notebook is the solution's, some exercises' cells replaced."""
    (folder,) = [each for each in lab_folders(LABS) if each.name.startswith(lab)]
    release([folder], tmp_path / "labs")
    path = notebook_path(tmp_path / "labs" / folder.name)
    if solved:
        notebook = json.loads(notebook_path(folder, solution=True).read_text(encoding="utf-8"))
        for cell in notebook["cells"]:
            text = (changes or {}).get(cell["metadata"].get("exercise"))
            cell["source"] = cell["source"] if text is None else text
        path.write_text(json.dumps(notebook), encoding="utf-8")
    return tmp_path / "labs"


def origins(choices, lab):
    """Whose each function of a lab is."""
    return {each.function: each.mine for each in choices if each.lab == lab}


def test_every_exercise_of_twelve_labs_has_its_place(tmp_path):
    """The names come from the labs' checks; nothing of a student: all are the kit's, all load."""
    choices = collect_mine(None, tmp_path / "parts")
    assert [part.lab for part in PARTS] == [f"lab{number:02d}" for number in range(1, 13)]
    expected = [
        exercise.name
        for folder in lab_folders(LABS)[:12]
        for exercise in load_checks(folder).exercises
    ]
    assert [each.function for each in choices] == expected
    assert not any(each.mine for each in choices)
    parts = load_parts(tmp_path / "parts")
    for each in choices:
        assert callable(getattr(getattr(parts, each.part), each.function)), each
    root = LABS.parent / "falconwing_kit"
    assert [file for part in PARTS for file in part.kit if not (root / file).is_file()] == []


def test_wrong_missing_and_deadly_functions_are_the_kits(tmp_path):
    """min_speed is the student's, with a comment as the mark; 5 m/s carries rho S C V^2 / 2 g.

    By hand: the turn at 60 degrees has load factor 2; the mass budget of one part is that part.
    """
    labs = student(
        tmp_path,
        "lab01",
        {
            "min_speed": "def half(x):\n    return 0.5 * x\n\n\n"
            "# my own way\ndef min_speed(mass_g, temperature_c):\n"
            "    rho = PRESSURE / (AIR_GAS_CONSTANT * (temperature_c + 273.15))\n"
            "    lift = half(rho) * WING_AREA * LIFT_COEFFICIENT\n"
            "    return np.sqrt(np.asarray(mass_g) / 1000 * GRAVITY / lift)  # N over N s2/m2\n",
            "level_turn": "def level_turn(v_min, bank_deg):\n    return 1.0, v_min, 3.0\n",
            "mass_budget": "def mass_budget(parts):\n    raise NotImplementedError\n",
            "max_mass_for_room": "import os\n\n\ndef max_mass_for_room(width, bank_deg, lift):\n"
            "    os._exit(0)\n",
        },
    )
    choices = collect_mine(labs, tmp_path / "mine")
    assert origins(choices, "lab01") == {
        "mass_budget": False,
        "min_speed": True,
        "level_turn": False,
        "max_mass_for_room": False,
    }
    why = {each.function: each.why for each in choices if each.lab == "lab01"}
    assert why["mass_budget"] == "not written" and why["level_turn"].startswith("failed: ")
    text = (tmp_path / "mine" / "sizing.py").read_text(encoding="utf-8")
    assert "# my own way\ndef min_speed" in text and "# N over N s2/m2" in text
    assert "os._exit" not in text
    sizing = load_parts(tmp_path / "mine").sizing
    rho = 101325.0 / (287.05 * 293.15)
    mass_g = 1000.0 * 0.5 * rho * 0.076 * 0.6 * 5.0**2 / 9.8
    assert sizing.min_speed(mass_g, 20.0) == pytest.approx(5.0, rel=1e-12)
    assert sizing.level_turn(5.0, 60.0)[0] == pytest.approx(2.0, rel=1e-12)
    assert sizing.mass_budget([("a", 2, 10.0, 5.0, "")]) == pytest.approx((20.0, 5.0))
    table = (tmp_path / "mine" / "README.md").read_text(encoding="utf-8")
    assert "| `sizing` | `min_speed` | mine |" in table
    assert "| `sizing` | `mass_budget` | the kit’s: not written |" in table


def test_functions_with_the_labs_files_around_them_only_are_the_kits(tmp_path):
    """Its check passes beside `data`, but the package is used elsewhere: it must load anywhere."""
    labs = student(
        tmp_path,
        "lab03",
        {
            "splat_alphas": 'KEPT = np.load("data/scene.npz")["means"]\n\n\n'
            "def splat_alphas(pixels, means_px, covs_px, opacities):\n"
            "    assert len(KEPT)\n"
            "    offsets = pixels[:, None, :] - means_px[None, :, :]\n"
            "    squares = np.einsum('pni,nij,pnj->pn', offsets, np.linalg.inv(covs_px), offsets)\n"
            "    alphas = np.minimum(0.999, opacities * np.exp(-0.5 * squares))\n"
            "    return np.where(squares <= COHORT['cut_sigma'] ** 2, alphas, 0.0)\n"
        },
    )
    choices = collect_mine(labs, tmp_path / "mine")
    assert set(origins(choices, "lab03").values()) == {False}
    assert {each.why for each in choices if each.lab == "lab03"} == {"its module does not load"}
    alphas = load_parts(tmp_path / "mine").renderer.splat_alphas(
        np.array([[1.0, 1.0]]), np.array([[1.0, 2.0]]), 0.5 * np.eye(2)[None], np.array([0.8])
    )
    assert alphas == pytest.approx(0.8 * math.exp(-1.0))  # one pixel off, variance 1/2 px^2


def test_given_and_constants_of_the_students_course_come_along(tmp_path):
    """The student's cohort.json has another reserve: n = 2 at 60 degrees, speed k V sqrt(2)."""
    labs = student(tmp_path, "lab01")
    file = next(labs.glob("lab01*")) / "cohort.json"
    file.write_text(json.dumps(json.loads(file.read_text()) | {"speed_reserve": 1.25}))
    choices = collect_mine(labs, tmp_path / "mine")
    assert set(origins(choices, "lab01").values()) == {True}
    assert not (tmp_path / "mine" / "kit" / "sizing.py").exists()
    speed = load_parts(tmp_path / "mine").sizing.level_turn(4.0, 60.0)[1]
    assert speed == pytest.approx(1.25 * 4.0 * math.sqrt(2.0))


def test_what_is_no_notebook_is_said_and_replaced(tmp_path):
    """An untouched notebook, and a file that is none."""
    labs = student(tmp_path, "lab01", solved=False)
    choices = collect_mine(labs, tmp_path / "mine")
    assert {each.why for each in choices if each.lab == "lab01"} == {"not written"}
    notebook_path(next(labs.glob("lab01*"))).write_text("<html>", encoding="utf-8")
    choices = collect_mine(labs, tmp_path / "mine")
    assert {"Jupyter notebook" in each.why for each in choices if each.lab == "lab01"} == {True}


def test_folder_of_something_else_is_refused(tmp_path):
    """Nothing of the student's is overwritten."""
    (tmp_path / "thesis").mkdir()
    (tmp_path / "thesis" / "text.md").write_text("mine")
    with pytest.raises(InputError, match="expected a new folder"):
        collect_mine(None, tmp_path / "thesis")
    with pytest.raises(InputError, match="a name that Python can import"):
        collect_mine(None, tmp_path / "my-falconwing")
    with pytest.raises(InputError, match="collect-mine first"):
        load_parts(tmp_path / "thesis")
    assert (tmp_path / "thesis" / "text.md").read_text() == "mine"


def test_verb_says_which_folder_has_no_labs(tmp_path, capsys):
    """Exit code 2, one sentence; nothing is written."""
    assert main(["labs", "collect-mine", str(tmp_path), "--out", str(tmp_path / "mine")]) == 2
    assert "expected a folder with your labs" in capsys.readouterr().err
    assert not (tmp_path / "mine").exists()


def test_verb_writes_a_package_that_imports_by_its_name(tmp_path, capsys, monkeypatch):
    """`import my_falconwing` from the folder; the table names the function that failed."""
    labs = student(
        tmp_path,
        "lab01",
        {"min_speed": "def min_speed(mass_g, temperature_c):\n    return mass_g\n"},
    )
    monkeypatch.chdir(tmp_path)
    assert main(["labs", "collect-mine", str(labs)]) == 0
    printed = capsys.readouterr().out
    assert "my_falconwing: 3 of" in printed and "! sizing.min_speed: failed: " in printed
    parts = load_parts("mine")
    assert parts.__name__ == "my_falconwing"
    assert parts.sizing.min_speed.__module__ == "my_falconwing.kit.sizing"
    assert parts.sizing.level_turn.__module__ == "my_falconwing.sizing"
