"""The quiz: numbers drawn by the course, answers read and not run, marks and diagnoses."""

import dataclasses
import json
import time

import pytest

from falconwing_kit.core.checks import InputError
from falconwing_kit.tools.grading import release as releasing
from falconwing_kit.tools.grading.collect import Notebook, SubmittedCell
from falconwing_kit.tools.grading.course.gradebook import (
    GradebookEntry,
    ManualGrade,
    gradescope_results,
)
from falconwing_kit.tools.grading.find import load_checks
from falconwing_kit.tools.grading.notebooks import build
from falconwing_kit.tools.grading.public_checks import check_quiz
from falconwing_kit.tools.grading.quiz import evaluate, form_text, read_form, read_quiz
from falconwing_kit.tools.grading.quiz_answers import (
    mark_answers,
    quiz_record,
    read_answers,
)
from falconwing_kit.tools.grading.release import release
from falconwing_kit.tools.grading.rules import read_rules
from tests.tools.grading import toys

QUIZ = """
[[question]]
tests = "a right angle"
kind = "number"
text = "An angle has the tangent <slope>. How large is it?"
draw = { slope = [1, 3, 0] }
formula = "atan(slope)"
unit = "rad"
explanation = "$\\\\arctan$ gives <answer> rad."
mistakes = [{ formula = "atan(1 / slope)", says = "this is the other angle" }]

[[question]]
tests = "weight"
kind = "one"
text = "What pulls?"
right = ["The Earth."]
wrong = [{ text = "The Moon.", says = "it is far away" }, { text = "The air.", says = "it pushes" }]
explanation = "It is near."

[[question]]
tests = "sums"
kind = "many"
text = "What is even?"
right = ["Two.", "Four."]
wrong = [{ text = "Three.", says = "it is odd" }]
explanation = "Halves are whole."
"""


@pytest.fixture
def folder(tmp_path):
    """A lab's folder with a quiz; by hand: the middle of 1 to 3 is 2, atan 2 = 1.10715 rad."""
    place = tmp_path / "lab01_small"
    place.mkdir()
    (place / "quiz.toml").write_text(QUIZ, encoding="utf-8")
    return place


def cells(*texts, role="quiz"):
    return Notebook(tuple(SubmittedCell(True, text, role, "quiz") for text in texts))


def marked(folder, text, key=""):
    """States and sentences of the three questions."""
    questions = read_quiz(folder, key, {})
    return [
        (mark.state, mark.said) for mark in mark_answers(questions, read_answers(cells(text))[0])
    ]


def letters(folder, *texts):
    """Letters of choices, whatever their order."""
    choices = [c.text for q in read_quiz(folder, "", {}) for c in q.choices]
    places = {text: "abc"[i % 3] for i, text in enumerate(choices)}
    return "".join(places[text] for text in texts)


def test_right_answers_get_their_explanations(folder):
    """1.107 rad is within 2 % of atan 2; the letters are those of the right choices."""
    earth, even = letters(folder, "The Earth."), tuple(letters(folder, "Four.", "Two."))
    text = f"quiz = {{1: 1.1, 2: '{earth}', 3: {even!r}}}"
    assert marked(folder, text) == [
        ("right", "$\\arctan$ gives 1.11 rad."),
        ("right", "It is near."),
        ("right", "Halves are whole."),
    ]


@pytest.mark.parametrize(
    ("typed", "state", "word"),
    [
        ("0.4636", "wrong", "this is the other angle"),  # atan 1/2
        ("63.43", "wrong", "this is the answer in degrees; the question asks for rad"),
        ("-1.107", "wrong", "the sign is not"),
        ("1107.15", "wrong", "too large by a factor of 1000"),
        ("2.2143", "wrong", "twice the right answer"),
        ("5.2", "wrong", ""),
        ("'1.107'", "unusable", "got the text '1.107'; write it without quotes"),
        ("(1, 107)", "unusable", "a decimal comma makes two numbers"),
        ("1e999", "unusable", "expected a plain number in rad"),
        ("10**400", "unusable", "expected a plain number in rad"),
        ("1" * 400, "unusable", "expected a plain number in rad"),
        ("True", "unusable", "got True"),
        ("atan(2)", "unusable", "got atan(2)"),
        ("['a']", "unusable", "got ['a']"),
        ("None", "not answered", ""),
    ],
)
def test_a_wrong_number_is_diagnosed(folder, typed, state, word):
    """By hand: 1.10715 rad is 63.43 deg; the states are those of the form."""
    (got, said), *_ = marked(folder, f"quiz = {{1: {typed}}}")
    assert got == state and word in said and bool(said) == bool(word)


@pytest.mark.parametrize(
    ("typed", "state", "word"),
    [
        ("2.0", "unusable", 'expected one letter of abc in quotes, such as "b", got 2'),
        ("'z'", "unusable", "expected one letter of abc, got 'z'"),
        ("'ab'", "unusable", "got 2 of them"),
        ("b", "unusable", "in quotes"),
        ("''", "not answered", ""),
    ],
)
def test_a_choice_of_the_wrong_form_is_said(folder, typed, state, word):
    """The form of one letter in quotes."""
    _, (got, said), _ = marked(folder, f"quiz = {{2: {typed}}}")
    assert got == state and word in said


def test_a_wrong_choice_says_why_and_half_of_the_right_ones_is_not_right(folder):
    """The sentence of the file; of "many" all right letters are needed, in any form."""
    moon = letters(folder, "The Moon.")
    assert marked(folder, f"quiz = {{2: '{moon}'}}")[1] == ("wrong", f"{moon}: it is far away")
    two = letters(folder, "Two.")
    assert marked(folder, f"quiz = {{3: '{two}'}}")[2] == (
        "wrong",
        "what you chose is right, but it is not all that is",
    )
    every = ", ".join(letters(folder, "Two.", "Four.")).upper()
    assert marked(folder, f"quiz = {{3: '{every}'}}")[2][0] == "right"


@pytest.mark.parametrize(
    ("texts", "problem"),
    [
        ((), "no cell sets quiz"),
        (("quiz = {1: 4",), "the quiz cell is not Python: line 1"),
        (("quiz = dict(a=1)",), "expected quiz = {1: ..., 2: ...}, got dict(a=1)"),
        (("quiz = {1.5: 2}",), "not the number of a question"),
        (("quiz = {1: 1.0, 1: 1.1}",), "answered twice; the last one counts"),
    ],
)
def test_a_bad_cell_is_said(folder, texts, problem):
    """Each in one sentence."""
    found = quiz_record(cells(*texts), read_quiz(folder, "", {}))
    assert problem in found["problem"]


def test_the_last_cell_of_the_role_counts_and_a_lost_role_does_not_matter(folder):
    """Copies of the cell are common; metadata get lost in other programs."""
    assert read_answers(cells("quiz = {1: 1.0}", "quiz: dict = {1: 2.0}\ncheck_quiz(quiz)"))[0] == {
        1: ("number", 2.0)
    }
    assert read_answers(cells("x = 1", "%time\nquiz = {'1': -3}", role=""))[0] == {
        1: ("number", -3.0)
    }


HOSTILE = [
    "quiz = {1: __import__('os').system('touch /tmp/falconwing-quiz-ran')}",
    "open('/tmp/falconwing-quiz-ran', 'w')\nquiz = {1: 1.107}",
    "quiz = {1: 9**9**9**9}",
    "quiz = {1: " + "(" * 3000 + "1" + ")" * 3000 + "}",
    "quiz = {1: " + "-" * 200_000 + "1}",
    "quiz = {" + ", ".join(f"{i}: 1" for i in range(50_000)) + "}",
    "quiz = {1: '" + "\\ud800" * 10 + "'}",
    "quiz = {**{1: 1.0}}",
    "quiz = {1: [" + "'a'," * 50_000 + "]}",
    "quiz = {1: '<script>alert(1)</script>', 2: {'a': 1}, 3: 1 .real}",
]


@pytest.mark.parametrize("text", HOSTILE, ids=range(len(HOSTILE)))
def test_a_hostile_cell_is_not_run_and_breaks_nothing(folder, text, tmp_path):
    """Nothing is written, reading is bounded, and the record goes into JSON."""
    from pathlib import Path

    Path("/tmp/falconwing-quiz-ran").unlink(missing_ok=True)
    begin = time.monotonic()
    found = quiz_record(cells(text), read_quiz(folder, "", {}))
    assert time.monotonic() - begin < 10.0
    assert found["right"] == ("1.107" in text)
    assert len(json.dumps(found).encode("ascii")) < 3000
    assert not Path("/tmp/falconwing-quiz-ran").exists()


def test_a_course_draws_its_numbers_and_its_order(folder):
    """Another key, another question; the same key, the same one; the open course has the middle."""
    keys = [f"{i:032d}" for i in range(40)]
    numbers = {read_quiz(folder, key, {})[0].expected for key in keys}
    orders = {tuple(c.text for c in read_quiz(folder, key, {})[1].choices) for key in keys}
    assert len(numbers) == 3 and len(orders) > 3  # atan of 1, 2 and 3; of the six orders
    assert read_quiz(folder, keys[0], {}) == read_quiz(folder, keys[0], {})
    assert read_quiz(folder, "", {})[0].text == "An angle has the tangent 2. How large is it?"


@pytest.mark.parametrize("formula", ["__import__('os')", "slope.real", "x", "[1]", "1 / 0", "1 +"])
def test_a_formula_is_arithmetic_only(formula):
    """Attributes, unknown names and calls of other things are refused."""
    with pytest.raises(InputError, match="the formula"):
        evaluate("quiz.toml", formula, {"slope": 2.0})


@pytest.mark.parametrize(
    ("was", "now", "why"),
    [
        ('kind = "one"', 'kind = "two"', "expected a kind of number, one, many"),
        ("unit =", "units =", "unknown: units"),
        ('right = ["The Earth."]', 'right = ["The Earth.", "x"]', "one in 'one'"),
        ("<slope>", "<slop>", "is not drawn"),
        ('"atan(slope)"', '"0 * slope"', "an answer but 0"),
        ("[[question]]", "[[frage]]", "expected"),
    ],
)
def test_a_bad_source_is_refused_with_its_place(folder, was, now, why):
    """The file and the question stand in the message."""
    (folder / "quiz.toml").write_text(QUIZ.replace(was, now, 1), encoding="utf-8")
    with pytest.raises(InputError, match=why):
        read_quiz(folder, "", {})


def test_students_get_the_form_only(folder, tmp_path):
    """The form holds neither numbers nor formulas, and it is enough to check an answer's form."""
    form = form_text(read_quiz(folder, "", {}))
    assert [sorted(each) for each in json.loads(form)] == [["choices", "kind", "unit"]] * 3
    (tmp_path / "quiz.json").write_text(form)
    answers = read_answers(cells("quiz = {1: 77.0, 2: 'x', 3: 'ab'}"))[0]
    states = [mark.state for mark in mark_answers(read_form(tmp_path), answers, known=False)]
    assert states == ["answered", "unusable", "answered"]


def test_points_count_only_where_the_course_says_so(folder, tmp_path):
    """By hand: 75 + 25 of 100 without the switch; with 5 points 2 of 3 right make 3.3333 of 105."""
    lab = load_checks(toys.LAB)
    quiz = {"right": 2, "of": 3, "questions": {}, "problem": ""}
    record = {"status": "graded", "points": 75.0, "problem": "", "exercises": {}, "quiz": quiz}
    entry = GradebookEntry(lab, "ada", record, ManualGrade({"figure": 25.0}))
    assert (entry.total, entry.of) == (100.0, 100.0)
    entry = dataclasses.replace(entry, quiz_points=5.0)
    assert (entry.total, entry.of) == (103.3333, 105.0)
    (test,) = [t for t in gradescope_results(entry, {})["tests"] if t["name"] == "quiz"]
    assert (test["score"], test["max_score"]) == (3.3333, 5.0)
    old = {name: each for name, each in record.items() if name != "quiz"}
    assert dataclasses.replace(entry, record=old).total is None  # graded before: to be regraded
    (tmp_path / "course.toml").write_text("quiz_points = 5\n")
    assert read_rules(tmp_path).quiz_points == 5.0


def test_a_lab_with_a_quiz_but_no_cell_is_refused(tmp_path):
    """Both or none."""
    from tests.tools.grading.small_lab import SOURCE

    place = tmp_path / "lab01_small"
    place.mkdir()
    (place / "lab.py").write_text(SOURCE)
    (place / "quiz.toml").write_text(QUIZ)
    with pytest.raises(InputError, match='quiz="quiz"'):
        build(place)


def test_a_release_asks_the_course_its_own_numbers(tmp_path, monkeypatch, capsys):
    """Lab 1, two courses: other numbers in the notebook, no answer in any file, a form check."""
    from tests.labs.run_notebook import ROOT

    lab = ROOT / "labs" / "lab01_sizing"
    monkeypatch.setattr(releasing, "hints_texts", lambda *_: [""])  # seconds, of other tests
    texts = []
    for number, key in enumerate(("1" * 64, "2" * 64)):
        out = tmp_path / f"out{number}"
        release([lab], out, key)
        texts.append((out / lab.name / "lab01.ipynb").read_text(encoding="utf-8"))
        questions = read_quiz(lab, key, {"speed_reserve": 1.1, "wall_clearance": 0.5})
        released = "".join(
            p.read_text(encoding="utf-8")
            for p in out.rglob("*")
            if p.suffix in (".ipynb", ".json", ".py")
        )
        for question in questions:
            assert question.explanation not in released
            assert not any(says.says and says.says in released for says in question.choices)
    asked = [t[t.index("## Quiz") : t.index("check_quiz(quiz)")] for t in texts]
    assert asked[0] != asked[1]
    monkeypatch.chdir(tmp_path / "out0" / lab.name)
    check_quiz({1: 7.0, 2: "8.9", 3: None, 4: "ab", 5: None})
    said = capsys.readouterr().out
    assert "quiz: 2 of 5 answered, to be marked when your notebook is graded, 2 left" in said
    assert "2 unusable: expected a plain number in m/s" in said
