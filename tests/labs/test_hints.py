"""Hints of the labs: a wrong function -> the mistake's name, expected beside got."""

import hashlib
import json
import time
from pathlib import Path

import numpy as np
import pytest

from falconwing_kit.tools.grading.find import lab_folders
from falconwing_kit.tools.grading.hints import (
    Hints,
    Recorder,
    answered,
    load_hints,
    numbers_of,
    parse_hints,
    raised,
)
from falconwing_kit.tools.grading.hints_library import hints_text, hints_texts
from falconwing_kit.tools.grading.public_checks import (
    _in_names_of,
    check,
    check_notebook,
    report_lines,
    run_checks,
)
from falconwing_kit.tools.grading.release import release
from falconwing_kit.tools.grading.sandbox.host import StudentError
from tests.labs.functions import ROOT, LabHere, library_functions
from tests.labs.holdout.generate import frozen
from tests.labs.judged_hints import judge_lab
from tests.labs.judged_rewrites import judge_rewrites, rewritten

FOLDERS = lab_folders(ROOT / "labs")
FROZEN = "44a4e4f177bb4a05b03a6f7fd7c3abeeb9f3523acc1b4944c854ea20e798d630"
LABS = {folder.name.split("_")[0]: folder for folder in FOLDERS}


def lines_for(lab: str, name: str, old: str, new: str, step: int = 2) -> str:
    """What a student reads whose function is the solution with `old` replaced by `new`."""
    here, hints = LabHere(LABS[lab]), load_hints(LABS[lab])[name]
    outcomes = run_checks(here.lab.exercise(name), here.function(name, old, new), hints)
    return "\n".join(report_lines(name, outcomes, step=step))


def named(hints, exercise, function) -> tuple[str, ...]:
    """The mistakes that are named for a function."""
    recorder = Recorder(function)
    run_checks(exercise, recorder)
    return hints.diagnose(recorder.calls).mistakes


@pytest.mark.parametrize(
    ("lab", "name", "old", "new", "cause"),
    [
        ("lab03", "alpha_composite", " + left[:, -1:] * background", "", "no background"),
        ("lab03", "project_gaussians", "J[:, 0, 0] = -lens", "J[:, 0, 0] = lens", "u by x"),
        ("lab06", "marker_pose", "U @ Vt,", "U @ Vt.T,", "V of the SVD"),
    ],
)
def test_mistake_is_named_and_the_usual_hint_is_silent(lab, name, old, new, cause):
    """A reader's own mistakes of 22 November, which the fixed hints took for others."""
    text = lines_for(lab, name, old, new)
    assert cause in text and "expected " in text
    assert "the first splat gets all light" not in text and "marker_square" not in text


def test_degrees_for_radians_are_named_without_a_list():
    """By hand: an angle in degrees is 180 / pi times the same in radians."""
    text = lines_for("lab04", "air_data", "np.arctan2(w, u)", "np.degrees(np.arctan2(w, u))")
    assert "degrees" in text


def test_right_function_and_unlike_mistake_are_called_nothing():
    """The solution has no diagnosis; random answers agree with no mistake."""
    here, hints = LabHere(LABS["lab01"]), load_hints(LABS["lab01"])["min_speed"]
    for function, silent in (
        (here.function("min_speed"), True),
        (lambda m, t: np.asarray(m) * 0.0 + 17.3 + np.sqrt(np.asarray(m)) * t, True),
    ):
        recorder = Recorder(function)
        run_checks(here.lab.exercise("min_speed"), recorder)
        assert (hints.diagnose(recorder.calls).cause == "") is silent


def test_complex_answer_is_called_complex():
    """By hand: a power 0.5 of a negative number is complex in Python."""
    here, hints = LabHere(LABS["lab01"]), load_hints(LABS["lab01"])["min_speed"]
    exercise = here.lab.exercise("min_speed")
    outcomes = run_checks(exercise, lambda m, t: (-np.asarray(m) + 0j) ** 0.5, hints)
    assert "complex" in "\n".join(report_lines("min_speed", outcomes))


def test_syntax_error_stands_under_its_function_alone(tmp_path):
    """The cell's own line, under the function that it was to define."""
    notebook = json.loads((LABS["lab01"] / "solution" / "lab01.ipynb").read_text("utf-8"))
    for cell in notebook["cells"]:
        if cell["metadata"].get("exercise") == "max_mass_for_room":
            cell["source"] = ["def max_mass_for_room(width, bank_deg, lift_per_speed2)\n", "    x"]
    path = tmp_path / "lab01.ipynb"
    path.write_text(json.dumps(notebook), encoding="utf-8")
    reports = {each.name: each for each in check_notebook(LABS["lab01"], path)}
    wrong = reports.pop("max_mass_for_room")
    assert "line 1" in wrong.outcomes[0].said and wrong.outcomes[0].state == "failed"
    assert not any("not Python" in words for each in reports.values() for words in each.problems)
    assert {each.state for report in reports.values() for each in report.outcomes} == {"passed"}


def test_stored_hints_are_what_the_lists_give():
    """Lab 1's file is written anew; its numbers agree (mend: `falconwing labs hints`)."""
    stored = json.loads((LABS["lab01"] / "hints.json").read_text("utf-8"))
    assert json.loads(hints_text(LABS["lab01"])) == stored


def test_processes_make_the_same_hints_as_one():
    """Lab 1 has numbers of the course in two exercises; the order of completion does not matter."""
    one, two = (hints_texts([LABS["lab01"]], "a" * 64, workers=n)[0] for n in (1, 2))
    assert one == two and json.loads(one)["exercises"].keys() == load_hints(LABS["lab01"]).keys()


def test_released_hints_are_of_the_course_and_hold_no_code(tmp_path):
    """With a salt the constants differ, so do the stored answers; no solution is in it."""
    release([LABS["lab01"]], tmp_path / "out", "a salt of the course")
    released = tmp_path / "out" / "lab01_sizing"
    assert load_hints(released)["level_turn"].expected
    stored = load_hints(LABS["lab01"])["level_turn"].expected
    assert load_hints(released)["level_turn"].expected != stored
    assert "np." not in (released / "hints.json").read_text("utf-8")


def test_the_frozen_list_is_as_the_issue_asks():
    """At least 500, half of them not of a single token, three or more an exercise."""
    kinds = [row["kind"] for row in frozen()]
    single = {"sign of a term", "comparison", "axis", "constant", "other function"}
    assert len(kinds) >= 500 and sum(kind in single for kind in kinds) <= len(kinds) / 2


@pytest.mark.parametrize("lab", ["lab01", "lab04"])
def test_few_wrong_causes_in_a_sample_of_the_frozen_list(lab):
    """At most 3 % wrong, half right; all labs are in tests/benchmarks/bench_hints.py."""
    found = judge_lab(LABS[lab])
    verdicts = [verdict for verdict, _, _ in found]
    assert verdicts.count("wrong") <= 0.03 * len(found)
    assert verdicts.count("right") >= 0.5 * len(found)


def test_a_hint_says_where_then_what_then_how():
    """Each step says more; the mistake is not named in the first one."""
    edit = ("lab01", "min_speed", "np.sqrt(2.0 * weight", "(2.0 * weight")
    first, second, third = (lines_for(*edit, step=step) for step in (1, 2, 3))
    assert "forgets the root" not in first and "what is returned" in first
    assert "forgets the root" in second and "to mend it" not in second
    assert "forgets the root" in third and "to mend it" in third
    assert all("expected 7.31" in text for text in (first, second, third))


def stored(hints) -> int:
    """How many mistakes are stored of an exercise."""
    return sum(len(boxes.split()) for each in hints.mistakes.values() for boxes in each.values())


def test_mistakes_are_found_by_their_functions_and_a_planted_one_is_not():
    """Nine of ten of one exercise; then two sealed texts change places and open no more."""
    here = LabHere(LABS["lab01"])
    exercise, functions = here.lab.exercise("min_speed"), library_functions(here, "min_speed")
    record = json.loads((LABS["lab01"] / "hints.json").read_text("utf-8"))
    hints = parse_hints(record)["min_speed"]
    found = {name: named(hints, exercise, function) for name, function in functions.items()}
    themselves = {name for name, names in found.items() if names[:1] == (name,)}
    assert stored(hints) >= 100 and len(themselves) >= 0.9 * stored(hints)
    name = "forgets the root"
    assert name in themselves
    for shape, boxes in record["exercises"]["min_speed"]["mistakes"].items():
        keys = list(boxes)
        moved = dict(zip(keys, [boxes[key] for key in keys[1:] + keys[:1]], strict=True))
        record["exercises"]["min_speed"]["mistakes"][shape] = moved
    assert named(parse_hints(record)["min_speed"], exercise, functions[name]) == ()


def test_ten_mistakes_or_more_are_stored_of_every_exercise():
    """The issue's number; lab 12's finding is four numbers and has fewer ways to be wrong."""
    for folder in FOLDERS:
        for name, hints in load_hints(folder).items():
            assert stored(hints) >= 10, name


def test_the_file_holds_no_words_of_a_mistake():
    """A list of all mistakes would describe the solution; whose answers agree has the key."""
    text = (LABS["lab01"] / "hints.json").read_text("utf-8")
    for words in ("forgets the root", "density", "sqrt", "GRAVITY", "missing"):
        assert words not in text
    assert "forgets the root" in lines_for("lab01", "min_speed", "np.sqrt(2.0 *", "(2.0 *")


@pytest.mark.parametrize(("lab", "name"), [("lab04", "trim"), ("lab06", "fit_similarity")])
def test_stored_marks_hold_on_a_platform_that_rounds_otherwise(lab, name):
    """Arguments and answers differ by 1e-13, as from another linear algebra library."""
    here, rng = LabHere(LABS[lab]), np.random.default_rng(3)
    hints, functions = load_hints(LABS[lab])[name], library_functions(here, name)

    def rounded(value):
        if isinstance(value, tuple):
            return tuple(map(rounded, value))
        if isinstance(value, np.ndarray) and value.dtype == float:
            return value * (1.0 + 1e-13 * rng.standard_normal(value.shape))
        return value

    exercise = here.lab.exercise(name)
    found = tried = 0
    for function in list(functions.values())[:: len(functions) // 80]:
        names = named(hints, exercise, function)
        if names:
            other = lambda *a, f=function: rounded(f(*map(rounded, a)))  # noqa: E731
            again = named(hints, exercise, other)
            assert again in ((), names)
            tried, found = tried + 1, found + (again == names)
    assert tried > 20 and found >= 0.9 * tried


def test_what_a_function_raises_stands_beside_what_was_expected():
    """By hand: 7.3174 m/s is the paper's speed; the function stops with ValueError."""
    here, hints = LabHere(LABS["lab01"]), load_hints(LABS["lab01"])["min_speed"]

    def raising(mass_g, temperature_c):
        raise ValueError("of the student")

    outcomes = run_checks(here.lab.exercise("min_speed"), raising, hints)
    text = "\n".join(report_lines("min_speed", outcomes))
    assert "expected (), 7.31" in text or "expected 7.31" in text
    assert "it raised ValueError" in text


def test_a_mistake_that_is_not_known_is_said_not_to_be(monkeypatch, capsys):
    """A further step of a hint that there is none of would print the same again without a word."""
    monkeypatch.chdir(LABS["lab01"])

    def min_speed(mass_g, temperature_c):
        return 0.0317 * mass_g + 11.3 * temperature_c**3

    for step, said in ((1, False), (2, True), (3, True)):
        check(min_speed, step=step)
        assert ("no known mistake answers like this" in capsys.readouterr().out) == said


def test_what_rounding_left_of_a_zero_is_shown_as_zero():
    """By hand: the check's point lies straight ahead, so its first coordinate is 0."""
    here, hints = LabHere(LABS["lab02"]), load_hints(LABS["lab02"])["map_to_camera"]

    def on_the_wrong_side(p_map, T_map_camera):
        return T_map_camera[:3, :3].T @ (p_map - T_map_camera[:3, 3])

    outcomes = run_checks(here.lab.exercise("map_to_camera"), on_the_wrong_side, hints)
    text = "\n".join(report_lines("map_to_camera", outcomes))
    assert "expected 0 at [0, 0], got" in text and "e-16 at" not in text


def test_nan_is_shown_as_nan():
    """A logarithm of zero is no zero."""
    hints = Hints(expected={"call": numbers_of(1.5)})
    assert hints.first_difference("call", numbers_of(np.nan)) == "expected 1.5, got nan"


def test_a_hint_names_no_variable_that_the_function_lacks():
    """`taken` stands in the solution only; `own` stands in the function, `inner` in its helper."""

    def written(x):
        own = x + 1.0

        def helper(y):
            inner = y
            return inner

        return helper(own)

    for place, kept in (("taken", False), ("own", True), ("inner", True), ("own and taken", False)):
        steps = (f"look at what gives {place}: is a factor missing?", "a cause", "a fix")
        nudge, *others = _in_names_of(written, steps)
        assert nudge.endswith(": is a factor missing?") and others == ["a cause", "a fix"]
        assert nudge.startswith("look at what gives" if kept else "go through your function")
    steps = ("look at the condition on x: is it turned round?", "a cause", "")
    assert _in_names_of(written, steps) == steps and _in_names_of(written, ()) == ()


def test_an_error_is_the_same_in_the_notebook_and_in_the_sandbox():
    """The sandbox says the type's name only; a timeout is no Python error."""
    assert raised(ValueError("x")) == raised(StudentError("exception:ValueError"))
    assert raised(ValueError("x")).mark == raised(StudentError("exception:ValueError")).mark
    assert raised(StudentError("timeout"))["raised"] == "Exception"
    assert answered(1.0).mark != raised(ValueError()).mark


def test_answers_that_are_drawn_at_random_are_called_nothing():
    """A function that draws numbers never gives the same again, so it agrees with no mistake."""
    here, rng = LabHere(LABS["lab01"]), np.random.default_rng()
    hints = load_hints(LABS["lab01"])["min_speed"]
    exercise = here.lab.exercise("min_speed")
    for _ in range(20):
        function = lambda m, t: np.asarray(m) * rng.uniform(0.5, 2.0)  # noqa: E731
        assert named(hints, exercise, function) == ()


def test_the_second_list_is_the_frozen_one_and_all_of_it_is_wrong():
    """Two or more ideas an exercise, none an edit of the solution; each loses points.

    Exercises of free structure came later; their hints are the listed mistakes alone.

    The checksum is that of the commit that froze the list, before the library was written.
    """
    files = sorted((Path(__file__).parent / "rewritten").glob("*.py"))
    text = b"".join(path.read_bytes().replace(b"\r\n", b"\n") for path in files)
    assert hashlib.sha256(text).hexdigest() == FROZEN
    for folder in FOLDERS[:4]:
        here = LabHere(folder)
        cases = list(rewritten(here))
        assert len(cases) >= 2 * sum(not each.free for each in here.lab.exercises)
        for name, idea, _, function in cases:
            assert here.score(name, function) < 1.0, idea


@pytest.mark.parametrize("lab", ["lab02", "lab06"])
def test_few_wrong_causes_in_a_sample_of_the_second_list(lab):
    """At most one of a lab's; silence is allowed, some are right."""
    verdicts = [each[0] for each in judge_rewrites(LABS[lab], load_hints(LABS[lab]))]
    assert verdicts.count("wrong") <= 1 and verdicts.count("right") >= 1


def test_all_hints_together_stay_small():
    """At most 3 MB over the course and 1 MB a lab."""
    sizes = [(folder / "hints.json").stat().st_size for folder in FOLDERS]
    assert sum(sizes) <= 3_000_000 and max(sizes) <= 1_000_000


def test_a_function_that_never_ends_on_arguments_nearby_is_left_after_a_second():
    """It answers the checks' 150 g and 80 g, wrongly, and loops on every mass in between."""
    here, hints = LabHere(LABS["lab01"]), load_hints(LABS["lab01"])["min_speed"]

    def endless(mass_g, temperature_c):
        while np.ndim(mass_g) == 0 and mass_g not in (150.0, 80.0):
            pass
        return np.asarray(mass_g) * 1.0

    begin = time.monotonic()
    outcomes = run_checks(here.lab.exercise("min_speed"), endless, hints)
    assert outcomes[0].state == "failed" and outcomes[0].cause == ""
    assert 0.9 < time.monotonic() - begin < 5.0
