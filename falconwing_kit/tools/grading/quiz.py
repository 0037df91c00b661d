r"""Quiz: a lab's `quiz.toml` and a course's key -> its questions, with their numbers and answers.

    [[question]]
    tests = "lift grows with the square of the speed"
    kind = "number"               # or "one" or "many": letters of the right choices
    text = "How fast must <mass> g fly, if 150 g need 7 m/s?"
    draw = { mass = [200, 500, 0] }   # lowest, highest, decimals: one number for each course
    formula = "7 * sqrt(mass / 150)"  # of drawn numbers and of the lab's course constants
    unit = "m/s"
    tolerance = 0.02              # relative
    explanation = "$V \\propto \\sqrt m$, so <answer> m/s."
    mistakes = [{ formula = "7 * mass / 150", says = "the speed goes with the root of the mass" }]

    [[question]]
    kind = "one"
    right = ["The first choice."]     # exactly one; several in "many"
    wrong = [{ text = "The second.", says = "why it is wrong" }]

A course's key draws the numbers and the order of the choices. Students get the questions in their
notebook and this file never; `quiz.json` beside it holds only the form of the answers.
"""

import ast
import hashlib
import json
import math
import operator
import re
import tomllib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from falconwing_kit.core.checks import InputError
from falconwing_kit.core.files import read_text
from falconwing_kit.tools.grading.lab import drawn_number

SOURCE, FORM = "quiz.toml", "quiz.json"  # of the instructor, of the student
KINDS = ("number", "one", "many")
LETTERS = "abcdef"
DEFAULT_TOLERANCE = 0.02
_NAME = re.compile(r"<([a-z][a-z0-9_]*)>")
_KEYS = {"tests", "kind", "text", "explanation"}
_NUMBER_KEYS = {"draw", "formula", "unit", "tolerance", "mistakes"}
_CHOICE_KEYS = {"draw", "right", "wrong"}


@dataclass(frozen=True)
class Choice:
    """A choice of a question, and why it is wrong; empty if it is right."""

    text: str
    says: str = ""


@dataclass(frozen=True)
class Question:
    """One question of a lab, with a course's numbers in it.

    Attributes:
        number: 1, 2, ...
        kind: "number", "one" (choice) or "many" (choices, any number of which are right).
        text: Markdown with LaTeX.
        tests: what it tests, for the instructor.
        explanation: shown after the right answer.
        expected: a number's value in `unit`; 0 for choices.
        unit: of a number; "-" if it has none.
        tolerance: of a number, relative.
        mistakes: values that known mistakes give, and a sentence on each.
        choices: in this course's order, lettered from a.
    """

    number: int
    kind: str
    text: str
    tests: str
    explanation: str
    expected: float = 0.0
    unit: str = ""
    tolerance: float = 0.0
    mistakes: tuple[tuple[float, str], ...] = ()
    choices: tuple[Choice, ...] = ()

    @property
    def right_letters(self) -> frozenset[str]:
        """Letters of the right choices."""
        pairs = zip(LETTERS, self.choices, strict=False)
        return frozenset(letter for letter, choice in pairs if not choice.says)

    @property
    def right_answer(self) -> float | str:
        """What the solution's notebook answers: a number of six digits, or letters."""
        if self.kind == "number":
            return float(f"{self.expected:.6g}")
        return "".join(sorted(self.right_letters))


def read_quiz(folder: Path, key: str, constants: Mapping[str, float]) -> tuple[Question, ...]:
    """The questions of a lab for a course; none where it has no `quiz.toml`.

    Args:
        folder: of the lab.
        key: of the course; empty for the open course, which has the middle of each range.
        constants: the lab's for this course, which formulas and texts may name.

    Raises:
        InputError: the file is not TOML, or a question is incomplete or inconsistent.
    """
    file = folder / SOURCE
    if not file.is_file():
        return ()
    try:
        content = tomllib.loads(read_text(file))
    except tomllib.TOMLDecodeError as error:
        raise InputError(f"{file}: expected TOML, got {error}") from None
    entries = content.get("question")
    if set(content) != {"question"} or not isinstance(entries, list) or not entries:
        raise InputError(f"{file}: expected [[question]] sections and nothing else")
    lab = folder.resolve().name.split("_")[0]
    return tuple(
        _question(f"{file}, question {number}", number, entry, (key, lab), constants)
        for number, entry in enumerate(entries, 1)
    )


def _question(
    where: str,
    number: int,
    entry: Mapping[str, Any],
    course: tuple[str, str],
    constants: Mapping[str, float],
) -> Question:
    kind = entry.get("kind")
    if kind not in KINDS:
        raise InputError(f"{where}: expected a kind of {', '.join(KINDS)}, got {kind!r}")
    extra = _NUMBER_KEYS if kind == "number" else _CHOICE_KEYS
    needed = _KEYS | ({"formula", "unit"} if kind == "number" else {"right", "wrong"})
    unknown, missing = sorted(set(entry) - _KEYS - extra), sorted(needed - set(entry))
    if unknown or missing:
        raise InputError(f"{where}: unknown: {', '.join(unknown)}; missing: {', '.join(missing)}")
    key, lab = course
    drawn = {
        name: drawn_number(f"{key}/{lab}" if key else "", f"quiz{number}/{name}", *limits)
        for name, limits in entry.get("draw", {}).items()
    }
    names = {**constants, **drawn}
    if kind == "number":
        value = evaluate(where, entry["formula"], names)
        mistakes = tuple(
            (evaluate(where, each["formula"], names), _filled(where, each["says"], names))
            for each in entry.get("mistakes", ())
        )
        tolerance = float(entry.get("tolerance", DEFAULT_TOLERANCE))
        if not value or not math.isfinite(value) or not 0.0 < tolerance < 0.5:
            raise InputError(f"{where}: expected an answer but 0, and a tolerance below 0.5")
        names = {**names, "answer": float(f"{value:.3g}")}
        parts: dict[str, Any] = {
            "expected": value,
            "unit": str(entry["unit"]),
            "tolerance": tolerance,
            "mistakes": mistakes,
        }
    else:
        parts = {"choices": _choices(where, kind, entry, f"{key}/{lab}/quiz{number}", names)}
    parts |= {name: _filled(where, str(entry[name]), names) for name in _KEYS - {"kind"}}
    return Question(number=number, kind=kind, **parts)


def _choices(
    where: str, kind: str, entry: Mapping[str, Any], course: str, names: Mapping[str, float]
) -> tuple[Choice, ...]:
    """The choices, shuffled by the course."""
    right = [Choice(_filled(where, text, names)) for text in entry.get("right", ())]
    wrong = [
        Choice(_filled(where, each["text"], names), _filled(where, each["says"], names))
        for each in entry.get("wrong", ())
    ]
    every = [*right, *wrong]
    if not right or (kind == "one" and len(right) > 1) or not all(each.says for each in wrong):
        raise InputError(f"{where}: expected right choices (one in 'one'), and says of wrong ones")
    if not 3 <= len(every) <= len(LETTERS) or len({each.text for each in every}) < len(every):
        raise InputError(f"{where}: expected 3 to {len(LETTERS)} different choices")

    def place(choice: Choice) -> bytes:
        return hashlib.sha256(f"{course}/{choice.text}".encode()).digest()

    return tuple(sorted(every, key=place))


def _filled(where: str, text: str, names: Mapping[str, float]) -> str:
    """A text with numbers in the place of `<name>`."""

    def number(found: re.Match[str]) -> str:
        if found[1] not in names:
            raise InputError(f"{where}: <{found[1]}> is not drawn and no constant of the lab")
        return f"{names[found[1]]:g}"

    return " ".join(_NAME.sub(number, text).split())


_OPERATORS: dict[type[ast.AST], Callable[..., float]] = {
    ast.Add: operator.add,
    ast.Sub: operator.sub,
    ast.Mult: operator.mul,
    ast.Div: operator.truediv,
    ast.Mod: operator.mod,
    ast.Pow: operator.pow,
    ast.USub: operator.neg,
}
_FUNCTIONS: dict[str, Callable[..., float]] = {
    name: getattr(math, name)
    for name in (
        *("sqrt", "sin", "cos", "tan", "asin", "acos", "atan", "atan2", "exp", "log", "hypot"),
        *("radians", "degrees", "comb", "ceil", "floor"),
    )
} | {"abs": abs, "round": round, "min": min, "max": max}


def evaluate(where: str, formula: str, names: Mapping[str, float]) -> float:
    """The value of a formula of numbers, names, + - * / % **, and functions such as sqrt.

    Args:
        where: for the message.
        formula: as in Python; angles of sin, cos and tan in rad.
        names: their values; pi is known.

    Raises:
        InputError: something else is in the formula, or it has no value.
    """

    def value(node: ast.expr) -> float:
        if isinstance(node, ast.Constant) and isinstance(node.value, int | float):
            return node.value
        if isinstance(node, ast.Name):
            return {"pi": math.pi, **names}[node.id]
        if isinstance(node, ast.BinOp):
            return _OPERATORS[type(node.op)](value(node.left), value(node.right))
        if isinstance(node, ast.UnaryOp):
            return _OPERATORS[type(node.op)](value(node.operand))
        if isinstance(node, ast.Call) and isinstance(node.func, ast.Name) and not node.keywords:
            return _FUNCTIONS[node.func.id](*map(value, node.args))
        raise ValueError(f"{type(node).__name__} is not allowed")

    try:
        return float(value(ast.parse(formula.strip(), mode="eval").body))
    except (SyntaxError, KeyError, ValueError, ArithmeticError, TypeError) as error:
        raise InputError(f"{where}: the formula {formula!r} has no value: {error}") from None


def questions_text(questions: Sequence[Question]) -> str:
    """The questions as Markdown, for the notebook."""
    parts = [
        "## Quiz\n"
        f"{len(questions)} questions, marked by machine. Write your answers into the cell below, "
        "in the place of `None`: a plain number in the unit asked for, or letters in quotes. When "
        "graded, the cell is read, not run, so no formulas. The numbers are those of your course."
    ]
    for each in questions:
        lines = [f"**{each.number}.** {each.text} *({_how(each)})*"]
        if each.choices:
            pairs = zip(LETTERS, each.choices, strict=False)
            lines += ["", *(f"- **{letter}** {choice.text}" for letter, choice in pairs)]
        parts.append("\n".join(lines))
    return "\n\n".join(parts)


def _how(each: Question) -> str:
    if each.kind == "number":
        unit = "a number without a unit" if each.unit == "-" else f"a number in {each.unit}"
        return f"{unit}, within {100.0 * each.tolerance:g} %"
    return "one letter" if each.kind == "one" else "all right letters together, such as `ad`"


def answers_line(questions: Sequence[Question], *, solved: bool) -> str:
    """The line of the quiz cell: `quiz = {1: None, ...}`, or with the right answers."""
    pairs = (f"{q.number}: {q.right_answer if solved else None!r}" for q in questions)
    return f"quiz = {{{', '.join(pairs)}}}"


def form_text(questions: Sequence[Question]) -> str:
    """Content of `quiz.json`: the form of each answer, and nothing about its value."""
    form = [
        {"kind": each.kind, "unit": each.unit, "choices": len(each.choices)} for each in questions
    ]
    return json.dumps(form, indent=1) + "\n"


def read_form(folder: Path) -> tuple[Question, ...]:
    """Questions of a student's folder: kind, unit and number of choices only; none without file."""
    file = folder / FORM
    if not file.is_file():
        return ()
    try:
        form = json.loads(read_text(file))
        return tuple(
            Question(
                number,
                str(each["kind"]),
                *("", "", ""),
                unit=str(each["unit"]),
                choices=(Choice(""),) * int(each["choices"]),
            )
            for number, each in enumerate(form, 1)
        )
    except (ValueError, KeyError, TypeError):
        raise InputError(f"{file}: expected the quiz as it was handed out; get it again") from None
