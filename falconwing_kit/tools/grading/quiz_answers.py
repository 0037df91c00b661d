"""Quiz marking: a student's notebook, not run, and the questions -> what is right, and why not.

The answers are the last `quiz = {1: ..., 2: ...}` of the notebook's quiz cell. Only literals are
read (numbers, texts, and tuples, lists and sets of them), in a bounded child process.
"""

import ast
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeGuard

from falconwing_kit.core.checks import InputError
from falconwing_kit.tools.grading.bounded import TooMuchError, call_bounded
from falconwing_kit.tools.grading.collect import (
    COLLECT_MIB,
    COLLECT_S,
    Notebook,
    parse_cell,
)
from falconwing_kit.tools.grading.find import load_checks
from falconwing_kit.tools.grading.lab import course_constants
from falconwing_kit.tools.grading.quiz import LETTERS, Question, read_form, read_quiz

NAME = "quiz"  # of the variable, and the role of its cell
RIGHT, WRONG, UNUSABLE, OPEN = "right", "wrong", "unusable", "not answered"
ANSWERED = "answered"  # of the right form; what it is worth only the grader says
SYMBOLS = {RIGHT: "✓", WRONG: "✗", UNUSABLE: "!", OPEN: "○", ANSWERED: "✓"}
MAX_SAID, MAX_ENTRIES = 60, 100
Answer = tuple[str, Any]  # "number", "text", "letters" (a list of texts), "none" or "other"


@dataclass(frozen=True)
class QuizMark:
    """One marked answer.

    Attributes:
        number: of the question.
        state: RIGHT, WRONG, UNUSABLE, OPEN or ANSWERED.
        said: explanation of a right one, diagnosis of another; may be empty.
    """

    number: int
    state: str
    said: str = ""


def read_answers(notebook: Notebook) -> tuple[dict[int, Answer], str]:
    """A student's answers by question, without running anything.

    Returns:
        The answers, and what is wrong with the cell as a whole; never raises, whatever it holds.
    """
    try:
        found, problem = call_bounded(lambda: _read(notebook), COLLECT_S, COLLECT_MIB)
    except TooMuchError:
        return {}, "the quiz cell takes too much time or memory to read; write plain answers"
    return {int(number): (kind, value) for number, kind, value in found}, str(problem)


def _read(notebook: Notebook) -> tuple[list[tuple[int, str, Any]], str]:
    marked = [cell.text for cell in notebook.cells if cell.code and cell.role == NAME]
    others = [cell.text for cell in notebook.cells if cell.code and cell.role != NAME]
    problem = f"no cell sets {NAME} = {{1: ...}}; restore the quiz cell"
    for texts in (marked, others):
        for text in reversed(texts):
            if NAME not in text:
                continue
            try:
                body = parse_cell(text).body
            except SyntaxError as error:
                problem = f"the quiz cell is not Python: line {error.lineno}, {error.msg}"
                continue
            except (ValueError, RecursionError, MemoryError):
                problem = "the quiz cell is not Python that can be read"
                continue
            values = [node.value for node in body if _sets(node)]
            if values and values[-1] is not None:
                return _entries(values[-1])
    return [], problem


def _sets(node: ast.stmt) -> TypeGuard[ast.Assign | ast.AnnAssign]:
    """Whether a statement assigns to `quiz` as a whole."""
    targets: list[ast.expr] = []
    if isinstance(node, ast.AnnAssign):
        targets = [node.target]
    elif isinstance(node, ast.Assign):
        targets = node.targets
    return any(isinstance(each, ast.Name) and each.id == NAME for each in targets)


def _entries(node: ast.expr) -> tuple[list[tuple[int, str, Any]], str]:
    if not isinstance(node, ast.Dict):
        return [], f"expected {NAME} = {{1: ..., 2: ...}}, got {_text_of(node)}"
    found: dict[int, tuple[int, str, Any]] = {}
    problem = ""
    for key, value in list(zip(node.keys, node.values, strict=True))[:MAX_ENTRIES]:
        number = key.value if isinstance(key, ast.Constant) else None
        if isinstance(number, str) and number.isascii() and number.isdigit() and len(number) < 4:
            number = int(number)
        if type(number) is not int or not 0 < number < 1000:
            problem = "a key of the quiz is not the number of a question"
            continue
        if number in found:
            problem = f"question {number} is answered twice; the last one counts"
        found[number] = (number, *_answer(value))
    return list(found.values()), problem


def _answer(node: ast.expr) -> Answer:
    sign = 1.0
    while isinstance(node, ast.UnaryOp) and isinstance(node.op, ast.USub | ast.UAdd):
        sign, node = -sign if isinstance(node.op, ast.USub) else sign, node.operand
    if isinstance(node, ast.Constant):
        value = node.value
        if value is None:
            return "none", None
        if isinstance(value, str):
            return "text", value[:MAX_SAID]
        if isinstance(value, int | float) and not isinstance(value, bool):
            try:
                number = sign * float(value)
            except OverflowError:
                number = math.inf
            return ("number", number) if math.isfinite(number) else ("other", _text_of(node))
    if isinstance(node, ast.List | ast.Tuple | ast.Set) and node.elts:
        inside = [each.value if isinstance(each, ast.Constant) else None for each in node.elts]
        if all(isinstance(each, str) for each in inside):
            return "letters", [str(each)[:MAX_SAID] for each in inside][:MAX_ENTRIES]
    return "other", _text_of(node)


def _text_of(node: ast.expr) -> str:
    try:
        text = " ".join(ast.unparse(node).split())
    except (RecursionError, ValueError, MemoryError):
        text = "something else"
    text = "".join(letter for letter in text if letter.isprintable())
    return text if len(text) <= MAX_SAID else text[: MAX_SAID - 3] + "..."


def mark_answers(
    questions: Sequence[Question], answers: Mapping[int, Answer], *, known: bool = True
) -> list[QuizMark]:
    """Mark each question.

    Args:
        answers: of `read_answers`.
        known: whether the questions have their answers; otherwise only the form is judged.
    """
    return [_mark(each, answers.get(each.number, ("none", None)), known) for each in questions]


def _mark(question: Question, answer: Answer, known: bool) -> QuizMark:
    kind, value = answer
    if kind == "none" or (kind == "text" and not value.strip()):
        return QuizMark(question.number, OPEN)
    judge = _mark_number if question.kind == "number" else _mark_choice
    state, said = judge(question, kind, value, known)
    return QuizMark(question.number, state, said)


def _mark_number(question: Question, kind: str, value: Any, known: bool) -> tuple[str, str]:
    unit = "" if question.unit == "-" else f" in {question.unit}"
    expected = f"expected a plain number{unit}, such as 4.2"
    if kind == "text":
        return UNUSABLE, f"{expected}, got the text {value!r}; write it without quotes"
    if kind != "number":
        value = str(value)
        comma = "; a decimal comma makes two numbers" if value.startswith("(") else ""
        return UNUSABLE, f"{expected}, got {value}{comma}; write the number itself"
    if not known:
        return ANSWERED, ""
    if _close(question, value, question.expected):
        return RIGHT, question.explanation
    return WRONG, _diagnosis(question, value)


def _close(question: Question, value: float, expected: float) -> bool:
    return abs(value - expected) <= question.tolerance * abs(expected)


def _diagnosis(question: Question, value: float) -> str:
    """What a wrong number comes from: a mistake of the question's own, or a usual one."""
    known = [*question.mistakes]
    right = question.expected
    angle = any(word in question.unit for word in ("rad", "deg"))
    if angle:
        known += [
            (math.degrees(right), "this is the answer in degrees; the question asks for rad"),
            (math.radians(right), "this is the answer in rad; the question asks for degrees"),
        ]
    known += [(-right, "the size is right, the sign is not")]
    for factor in (10.0, 100.0, 1e3, 1e6):
        known += [(right * factor, f"too large by a factor of {factor:g}: check the unit")]
        known += [(right / factor, f"too small by a factor of {factor:g}: check the unit")]
    known += [
        (2.0 * right, "twice the right answer: look for a factor of 2"),
        (0.5 * right, "half of the right answer: look for a factor of 2"),
        (right**2, "this is the square of the right answer"),
        (1.0 / right, "this is the reciprocal of the right answer"),
    ]
    if right > 0.0:
        known += [(math.sqrt(right), "this is the root of the right answer")]
    return next((said for wrong, said in known if _close(question, value, wrong)), "")


def _mark_choice(question: Question, kind: str, value: Any, known: bool) -> tuple[str, str]:
    letters = LETTERS[: len(question.choices)]
    expected = f"expected {'letters' if question.kind == 'many' else 'one letter'} of {letters}"
    if kind not in ("text", "letters"):
        got = f"{value:g}" if kind == "number" else value
        return UNUSABLE, f'{expected} in quotes, such as "b", got {got}'
    typed = "".join(value).lower()
    chosen = [letter for letter in typed if letter not in " ,;.()"]
    if not set(chosen) <= set(letters) or len(set(chosen)) < len(chosen) or not chosen:
        return UNUSABLE, f"{expected}, got {typed[:MAX_SAID]!r}"
    if question.kind == "one" and len(chosen) > 1:
        return UNUSABLE, f"{expected}, got {len(chosen)} of them"
    if not known:
        return ANSWERED, ""
    if set(chosen) == question.right_letters:
        return RIGHT, question.explanation
    for letter in sorted(chosen):
        choice = question.choices[letters.index(letter)]
        if choice.says:
            return WRONG, f"{letter}: {choice.says}"
    return WRONG, "what you chose is right, but it is not all that is"


def quiz_record(notebook: Notebook, questions: Sequence[Question]) -> dict[str, Any]:
    """The quiz's part of a record: `right` of `of`, the mark of each question, and a `problem`."""
    answers, problem = read_answers(notebook)
    marks = mark_answers(questions, answers)
    return {
        "right": sum(mark.state == RIGHT for mark in marks),
        "of": len(marks),
        "questions": {str(mark.number): [mark.state, mark.said] for mark in marks},
        "problem": problem,
    }


def quiz_here(folder: Path) -> tuple[tuple[Question, ...], bool]:
    """A lab's questions as this folder has them, and whether their answers are known.

    A checkout has `quiz.toml`, with the open course's numbers; a student's folder only the form.

    Raises:
        InputError: the file cannot be used, or there is none.
    """
    questions = read_quiz(folder, "", course_constants(load_checks(folder), ""))
    if questions:
        return questions, True
    form = read_form(folder)
    if not form:
        raise InputError(f"{folder}: expected a lab with a quiz, found no quiz.json in it")
    return form, False


def quiz_lines(questions: Sequence[Question], marks: Sequence[QuizMark], known: bool) -> list[str]:
    """What a student reads about the quiz."""
    done = sum(mark.state in (RIGHT, ANSWERED) for mark in marks)
    left = sum(mark.state == OPEN for mark in marks)
    word = "right" if known else "answered, to be marked when your notebook is graded"
    lines = [f"quiz: {done} of {len(questions)} {word}" + (f", {left} left" if left else "")]
    for mark in marks:
        if mark.state not in (OPEN, ANSWERED):
            said = f": {mark.said}" if mark.said else ""
            lines.append(f"   {SYMBOLS[mark.state]} {mark.number} {mark.state}{said}")
    return lines
