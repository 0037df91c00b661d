"""Outputs of a lab's solution: what its cells show is kept, its code is not."""

import json

import pytest

from falconwing_kit.core.checks import InputError
from falconwing_kit.tools.grading.notebooks import write_notebooks
from falconwing_kit.tools.grading.outputs import write_outputs
from tests.tools.grading.small_lab import SOURCE, write_small_lab


@pytest.fixture
def lab(tmp_path):
    """A lab of one exercise whose last cell prints the weight of 2 kg, and draws a line."""
    folder = write_small_lab(tmp_path / "labs")
    line = "import matplotlib.pyplot as plt\nprint(weight(2.0))\nplt.plot([0.0, 1.0])"
    source = SOURCE.replace("print(weight(2.0))", line)
    (folder / "lab.py").write_text(source, encoding="utf-8")
    write_notebooks(folder)
    return folder


def test_outputs_are_those_of_the_solution_without_its_code(lab, tmp_path):
    """By hand: 2 kg at 10 m/s^2 weigh 20 N; one picture; no cell of the exercise."""
    path = write_outputs(lab, tmp_path / "cache")
    assert path == tmp_path / "cache" / "lab01_small.json"
    shown = json.loads(path.read_text(encoding="utf-8"))
    (figure,) = [outputs for source, outputs in shown.items() if "plt.plot" in source]
    assert figure[0]["text"] == "20.0\n"
    assert ["image/png" in output.get("data", {}) for output in figure].count(True) == 1
    assert not any("newtons" in source for source in shown)


def test_words_and_width_of_a_film_are_kept(lab, tmp_path):
    """As given to `moving_pictures` in a cell."""
    film = (
        "from falconwing_kit.tools.grading import moving_pictures\n"
        'display(moving_pictures([[[0, 1], [2, 3]]], 0.1, "four pixels", 480))'
    )
    source = (lab / "lab.py").read_text(encoding="utf-8")
    (lab / "lab.py").write_text(source.replace("print(weight(2.0))", film), encoding="utf-8")
    write_notebooks(lab)
    shown = json.loads(write_outputs(lab, tmp_path / "cache").read_text(encoding="utf-8"))
    (outputs,) = [each for text, each in shown.items() if "moving_pictures" in text]
    words = outputs[0]["metadata"]["image/gif"]
    assert words["alt"] == "four pixels" and words["width"] == 480


def test_a_failing_solution_is_refused(lab, tmp_path):
    """One sentence with the notebook and what was raised; no file is written."""
    source = (lab / "lab.py").read_text(encoding="utf-8")
    (lab / "lab.py").write_text(source.replace("print(weight(2.0))", "1 / 0"), encoding="utf-8")
    write_notebooks(lab)
    with pytest.raises(InputError, match=r"lab01\.ipynb: expected .* got ZeroDivisionError"):
        write_outputs(lab, tmp_path / "cache")
    assert not (tmp_path / "cache").exists()
