"""Library of mistakes: a lab's solution, its listed mistakes and mutations -> `hints.json`.

Each mistake of an exercise is run through the public checks; the marks of its answers, its name,
kind and place are stored, not its code. Mistakes that the checks cannot tell apart are compared on
arguments nearby: the same function gets one name, different functions are named together where
they are few and of one kind, or where one of them is listed, which then comes first; all others are
left out, so that nothing wrong is said.
"""

import ast
import copy
import importlib.util
import json
import os
import re
import signal
import threading
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from falconwing_kit.tools.grading.collect import Notebook, SubmittedCell, collect_source
from falconwing_kit.tools.grading.find import importable_given, load_checks, load_module
from falconwing_kit.tools.grading.hints import (
    FILE,
    Nearby,
    Numbers,
    Recorder,
    copied,
    errors_text,
    same,
    same_numbers,
)
from falconwing_kit.tools.grading.lab import Exercise, Function, Lab, course_constants
from falconwing_kit.tools.grading.marks import (
    UNSTABLE,
    Mark,
    mark_of,
    matches_text,
    raised_mark,
    trace_of,
    trace_text,
)
from falconwing_kit.tools.grading.mistakes import mistakes_of
from falconwing_kit.tools.grading.notebooks import SourceCell, read_cells
from falconwing_kit.tools.grading.sealed import LISTED, Words, seal
from falconwing_kit.tools.jobs.pool import WorkerLostError
from falconwing_kit.tools.jobs.run import parallel_map

FIRST_CALLS, CALLS = 6, 24  # calls whose right answers are stored: the first, and most telling ones
SHOWN_BYTES = 9000  # of an exercise's stored right answers
ROUNDS, CPU_SECONDS, MEMORY = 100_000, 2.0, 3 << 29  # limits of one mistake's run
ALTERNATIVES = 3
PROBES = 10
_INSIDE = re.compile(r"# BEGIN SOLUTION\n(.*?)[ \t]*# END SOLUTION", re.DOTALL)
_UNLIKELY = ("1000 times", "loses its sign", "replaced by zeros", "the root is taken", "squared")


@dataclass(frozen=True)
class Entry:
    """One mistake: its words, and the stored text of what it returns in the public checks."""

    trace: str
    words: Words


class _TooLongError(BaseException):
    """A mistake's function does not end; no check may catch it."""


@dataclass(frozen=True)
class _Candidate:
    name: str
    kind: str
    place: str
    function: Function
    rank: int

    def words(self) -> Words:
        """What is said of it; a listed mistake has no place."""
        return Words(self.name, self.kind, self.place)


class ExerciseHere:
    """An exercise whose solution and mistakes run in this process.

    Args:
        folder: the lab's, in a checkout.
        salt: the course's key; empty for the open course.
    """

    def __init__(self, folder: Path, lab: Lab, exercise: Exercise, given: Any) -> None:
        self.exercise, self.given = exercise, given
        self.cells = [cell for cell in read_cells(folder / "lab.py") if not cell.markdown]
        self.packages = lab.packages
        source = self._source()
        tree = ast.parse(source)
        self.definition = next(
            node
            for node in reversed(tree.body)
            if isinstance(node, ast.FunctionDef | ast.ClassDef) and node.name == exercise.name
        )
        self.namespace: dict[str, Any] = {"__name__": "notebook"}
        exec(compile(source, exercise.name, "exec"), self.namespace)

    def _source(self, old: str = "", new: str = "") -> str:
        submitted = []
        for cell in self.cells:
            text = cell.for_solution()
            if old and cell.kind == "exercise" and cell.name == self.exercise.name:
                text = _replaced(cell, old, new)
            submitted.append(SubmittedCell(True, text))
        notebook = Notebook(tuple(submitted))
        return collect_source(notebook, self.exercise.name, self.packages).text

    def edited(self, old: str = "", new: str = "") -> Function:
        """The solution's function, or with `old` replaced by `new` inside the solution."""
        tree = ast.parse(self._source(old, new))
        return self.function(ast.unparse(tree))

    def function(self, source: str) -> Function:
        """A function of the exercise's name from its source, on copies of its arguments."""
        tree = _ticking(ast.parse(source))
        rounds = [0]

        def tick() -> None:
            rounds[0] += 1
            if rounds[0] > ROUNDS:
                raise _TooLongError

        namespace = {**self.namespace, "_tick": tick}
        exec(compile(tree, self.exercise.name, "exec"), namespace)
        written = namespace[self.exercise.name]

        def called(*arguments: Any) -> Any:
            rounds[0] = 0
            arguments = copied(arguments)
            if self.exercise.through:
                return getattr(self.given, self.exercise.through)(written, *arguments)
            return written(*arguments)

        called.__name__ = self.exercise.name
        return called


def _replaced(cell: SourceCell, old: str, new: str) -> str:
    inside = _INSIDE.search(cell.text)
    if inside is None:
        return cell.text
    body = inside[1].replace(old, new)
    return cell.text[: inside.start(1)] + body + cell.text[inside.end(1) :]


def _ticking(tree: ast.Module) -> ast.Module:
    """Every loop counts its rounds, so that one without an end is stopped."""
    for node in ast.walk(tree):
        if isinstance(node, ast.While | ast.For):
            node.body.insert(0, ast.parse("_tick()").body[0])
    return ast.fix_missing_locations(tree)


def listed_mistakes(folder: Path, lab: Lab) -> Mapping[str, tuple[tuple[str, str, str], ...]]:
    """The lab's hand-written mistakes: of each exercise name, old and new text; {} if none.

    They stand in a checkout's `tests/labs/mutants`, whose entries must also lose points.
    """
    path = folder.resolve().parents[1] / "tests" / "labs" / "mutants" / f"{lab.name}.py"
    spec = importlib.util.spec_from_file_location(f"mistakes_of_{lab.name}", path)
    if not path.is_file() or spec is None or spec.loader is None:
        return {}
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    found: Mapping[str, tuple[tuple[str, str, str], ...]] = module.MUTANTS
    return found


def hints_text(folder: Path, salt: str = "", *, listed: bool = True) -> str:
    """Content of one lab's `hints.json`, see `hints_texts`; computed in this process."""
    return hints_texts([folder], salt, listed=listed, workers=1)[0]


def hints_texts(
    folders: Sequence[Path], salt: str = "", *, listed: bool = True, workers: int = 0
) -> list[str]:
    """Content of each lab's `hints.json` for a course; "" where a lab lists no mistakes.

    Args:
        folders: the labs', in a checkout, with `lab.py`.
        salt: the course's key; empty for the open course.
        listed: with the hand-written mistakes; without them only mutations are in it.
        workers: processes; 0 for as many as there are processors.
    """
    jobs: list[_Job] = []
    for folder in folders:
        if listed_mistakes(folder, load_checks(folder)):
            jobs += [
                _Job(folder, each.name, salt, listed) for each in load_checks(folder).exercises
            ]
    sizes = {job: len(str(_shipped(job.folder).get(job.exercise, ""))) for job in jobs}
    jobs.sort(key=lambda job: -sizes[job])  # long ones first, so that no process is left alone
    workers = workers or workers_for(jobs)
    records: dict[tuple[Path, str], dict[str, Any]] = {}
    for job, record in parallel_map(_record_of, jobs, workers):
        if isinstance(record, WorkerLostError):
            raise record
        records[job.folder, job.exercise] = record
    texts = []
    for folder in folders:
        lab = load_checks(folder)
        names = [each.name for each in lab.exercises if (folder, each.name) in records]
        content = {
            "constants": course_constants(lab, salt),
            "exercises": {name: records[folder, name] for name in names},
        }
        text = json.dumps(content, ensure_ascii=False, separators=(",", ":")) + "\n"
        texts.append(text if names else "")
    return texts


def workers_for(jobs: Sequence[object]) -> int:
    """As many processes as there are processors and jobs; few jobs are done in this one."""
    return min(os.cpu_count() or 1, len(jobs) // 2)


@dataclass(frozen=True)
class _Job:
    folder: Path
    exercise: str
    salt: str
    listed: bool


def _record_of(job: _Job) -> dict[str, Any]:
    """What `hints.json` holds of one exercise, from its lab's folder."""
    constants = course_constants(load_checks(job.folder), job.salt)
    lab: Lab = load_module(job.folder, "checks", constants).LAB
    by_hand = listed_mistakes(job.folder, lab).get(job.exercise, ()) if job.listed else ()
    shipped = _shipped(job.folder).get(job.exercise, {}) if job.salt else {}
    given = load_module(job.folder, "given", constants)
    with (
        importable_given(given),
        np.errstate(all="ignore"),
        warnings.catch_warnings(),  # mistakes divide by zero, and more
        _memory_limit(),
    ):
        warnings.simplefilter("ignore")
        here = ExerciseHere(job.folder, lab, lab.exercise(job.exercise), given)
        return exercise_record(here, by_hand, shipped)


def _shipped(folder: Path) -> Mapping[str, Any]:
    """The open course's record of each exercise; {} where there is none."""
    with suppress(OSError, ValueError, KeyError, TypeError):
        record: Mapping[str, Any] = json.loads((folder / FILE).read_text(encoding="utf-8"))
        return dict(record["exercises"])
    return {}


def exercise_record(
    here: ExerciseHere, by_hand: Sequence[tuple[str, str, str]], shipped: Mapping[str, Any]
) -> dict[str, Any]:
    """What `hints.json` holds of one exercise.

    Args:
        here: the exercise.
        by_hand: its listed mistakes.
        shipped: the record of the open course, if this is another one: where the right answers are
            the same, the course's numbers do not enter and the record is taken as it is.
    """
    right = here.function(ast.unparse(here.definition))
    expected, trace, shakes = _run(here.exercise, right)
    text = trace_text(trace, _run(here.exercise, _shaken(right))[1] if shakes else trace)
    if shipped and shipped.get("trace") == text and _is_of_any_course(here, expected, shipped):
        return dict(shipped)
    entries: list[tuple[_Candidate, Entry]] = []
    first_wrong: dict[str, int] = {}
    for candidate in candidates(here, by_hand):
        found = _entry(here, candidate, expected, trace)
        if found:
            entries.append((candidate, found[0]))
            first_wrong[found[1]] = first_wrong.get(found[1], 0) + 1
    probes = [] if here.exercise.free else _probes(here.exercise, right)
    told = _told_apart(entries, probes, free=here.exercise.free)
    named = [(each.trace, each.words) for each in told]
    return {
        "expected": _telling(expected, first_wrong),
        "trace": text,
        "mistakes": seal(named),
    }


def _is_of_any_course(here: ExerciseHere, expected: Recorder, shipped: Mapping[str, Any]) -> bool:
    """Whether neither the function nor the questions to it contain the course's numbers."""
    asked = {key for key, _ in expected.calls}
    return asked >= set(shipped["expected"]) and "COHORT" not in ast.unparse(here.definition)


def candidates(here: ExerciseHere, by_hand: Sequence[tuple[str, str, str]]) -> list[_Candidate]:
    """All mistakes of an exercise: listed ones first, then mutations of a function.

    A free exercise has listed ones alone: nothing is known of the lines of another structure.
    """
    found = [_Candidate(name, LISTED, "", here.edited(old, new), 0) for name, old, new in by_hand]
    if here.exercise.free or not isinstance(here.definition, ast.FunctionDef):
        return found
    for each in mistakes_of(here.definition):
        with suppress(SyntaxError):
            rank = 2 if any(words in each.name for words in _UNLIKELY) else 1
            found.append(
                _Candidate(each.name, each.kind, each.place, here.function(each.source), rank)
            )
    return found


def _run(exercise: Exercise, function: Function) -> tuple[Recorder, tuple[Mark, ...], bool]:
    """The calls that `run_checks` makes, their marks, and whether `_shaken` would change any."""
    recorder, nearby, failed, shakes = Recorder(function), Nearby(), False, False

    def asked(*arguments: Any) -> Any:
        nonlocal shakes
        shakes = shakes or any(map(_can_shake, arguments))
        nearby.take(arguments)
        return recorder(*arguments)

    for each in exercise.checks:
        holds = False
        with suppress(Exception):  # a wrong answer may break the check after the call
            holds = bool(each.holds(asked))
        failed = failed or not holds
    for arguments in nearby if failed and exercise.nearby else ():
        with suppress(Exception):
            recorder(*arguments)
    return recorder, trace_of([answer.mark for _, answer in recorder.calls]), shakes


def _entry(
    here: ExerciseHere, candidate: _Candidate, expected: Recorder, trace: tuple[Mark, ...]
) -> tuple[Entry, str] | None:
    """The entry and the key of the first wrong call; None where it says nothing."""
    try:
        with _time_limit():
            got, wrong, shakes = _run(here.exercise, candidate.function)
            if len(wrong) == len(trace) and all(
                a.agrees(b) for a, b in zip(wrong, trace, strict=True)
            ):
                return None
            errors = [answer.get("raised") for _, answer in got.calls]
            if "MemoryError" in errors:
                return None
            if all(errors):
                return _raising(candidate, got)
            again = _run(here.exercise, _shaken(candidate.function))[1] if shakes else wrong
    except _TooLongError:
        return None
    text = trace_text(wrong, again)
    if not _differs(text, trace):
        return None
    right = dict(expected.calls)
    if candidate.rank > 1 and not any(_tells(answer, right.get(key)) for key, answer in got.calls):
        return None
    first = next(
        (key for key, answer in got.calls if key in right and not same_numbers(answer, right[key])),
        "",
    )
    return Entry(text, candidate.words()), first


def _tells(got: Numbers, right: Numbers | None) -> bool:
    """Whether a wrong answer is one that few mistakes give: a number that is not whole."""
    return any(
        isinstance(value, float)
        and np.isfinite(value)
        and value != round(value)
        and (right is None or place not in right or not same(value, right[place]))
        for place, value in got.items()
    )


def _raising(candidate: _Candidate, got: Recorder) -> tuple[Entry, str] | None:
    """The entry of a mistake that only raises: the texts of its errors."""
    text = errors_text(got.calls)
    first = got.calls[0][0] if got.calls else ""
    entry = Entry(text, candidate.words())
    return (entry, first) if text else None


def _differs(text: str, trace: tuple[Mark, ...]) -> bool:
    """Whether a stable part of a stored trace is not that of the right answers."""
    for i, part in enumerate(text.split(" ")):
        if part != UNSTABLE and (i >= len(trace) or not matches_text(trace[i : i + 1], part)):
            return True
    return False


def _told_apart(
    entries: list[tuple[_Candidate, Entry]], probes: list[Any], *, free: bool = False
) -> list[Entry]:
    """One entry for each trace: mistakes that give the same are named as the module says.

    Those of a free exercise are different mistakes by their list, whatever they give on arguments
    nearby: few are named together, many are left out.
    """
    groups: dict[str, list[tuple[_Candidate, Entry]]] = {}
    for candidate, entry in entries:
        groups.setdefault(_bucket(entry.trace), []).append((candidate, entry))
    found = []
    for members in groups.values():
        functions: list[tuple[list[Mark], list[tuple[_Candidate, Entry]]]] = []
        for candidate, entry in members:
            marks = _marks(candidate.function, probes) if len(members) > 1 else []
            for known, alike in functions:
                if not free and all(a.agrees(b) for a, b in zip(known, marks, strict=True)):
                    alike.append((candidate, entry))
                    break
            else:
                functions.append((marks, [(candidate, entry)]))
        named = [_named([each for _, each in same]) for _, same in functions]
        ranks = [min(candidate.rank for candidate, _ in same) for _, same in functions]
        likely = [entry for entry, rank in zip(named, ranks, strict=True) if rank < 2] or named
        kinds = {entry.words.kind for entry in likely}
        if ranks.count(0) == 1:  # what a person listed comes first, whatever else it could be
            first = named[ranks.index(0)]
            likely = [first, *(each for each in likely if each is not first)]
            kinds = {first.words.kind}
        if len(likely) == 1 or (len(kinds) == 1 and len(likely) <= ALTERNATIVES):
            words = replace(
                likely[0].words, alternatives=tuple(each.words.name for each in likely[1:])
            )
            found.append(replace(likely[0], words=words))
    return found


def _bucket(trace: str) -> str:
    return " ".join(
        part if part[0] in "*!" else f"{part[:4]}{float(part[4:]):.3f}" for part in trace.split(" ")
    )


def _named(entries: list[Entry]) -> Entry:
    """Of mistakes that are one function the first, with the kind and place of a mutation."""
    twin = next((each.words for each in entries if each.words.kind != LISTED), entries[0].words)
    words = replace(entries[0].words, kind=twin.kind, place=twin.place)
    return replace(entries[0], words=words)


def _probes(exercise: Exercise, right: Function) -> list[Any]:
    """Arguments near those of the public checks."""
    taken: list[Any] = []

    def taking(*arguments: Any) -> Any:
        if len(taken) < PROBES:
            taken.append(copy.deepcopy(arguments))
        return right(*arguments)

    for each in exercise.checks:
        with suppress(Exception):
            each.holds(taking)
    rng = np.random.default_rng(0)
    return [tuple(_near(value, rng) for value in arguments) for arguments in taken]


def _near(value: Any, rng: np.random.Generator) -> Any:
    if isinstance(value, float):
        return value * (1.0 + 0.5 * rng.standard_normal()) + 0.1 * rng.standard_normal()
    if isinstance(value, np.ndarray) and value.dtype.kind == "f":
        noise = 0.5 * rng.standard_normal(value.shape)
        return (value * (1.0 + noise)).astype(value.dtype)
    if isinstance(value, dict):
        return {key: _near(each, rng) for key, each in value.items()}
    return value


def _marks(function: Function, probes: list[Any]) -> list[Mark]:
    found = []
    for arguments in probes:
        try:
            with _time_limit():
                found.append(mark_of(function(*arguments)))
        except (Exception, _TooLongError) as error:
            found.append(raised_mark(type(error).__name__))
    return found


def _telling(expected: Recorder, first_wrong: Mapping[str, int]) -> dict[str, Numbers]:
    """Right answers to show: of the first calls, and of those in which mistakes first differ."""
    answers: dict[str, Numbers] = {}
    for key, answer in expected.calls:
        answers.setdefault(key, answer)
    keys = list(answers)
    order = sorted(keys, key=lambda key: -first_wrong.get(key, 0))
    wanted = dict.fromkeys(
        [*(key for key in order if first_wrong.get(key)), *keys[:FIRST_CALLS], *keys]
    )
    found: dict[str, Numbers] = {}
    size = 0
    for key in wanted:
        size += len(json.dumps(answers[key]))
        if len(found) < CALLS and (size <= SHOWN_BYTES or len(found) < FIRST_CALLS):
            found[key] = dict(answers[key])
    return {key: found[key] for key in keys if key in found}


def _can_shake(value: Any) -> bool:
    return isinstance(value, np.ndarray) and value.dtype == np.float64


def _shaken(function: Function) -> Function:
    """The function on arrays that differ by rounding, at 1e-12.

    An answer that changes with them is no fingerprint: a wrong formula may take the singular
    vectors of equal singular values, which are arbitrary.
    """
    rng = np.random.default_rng(0)

    def called(*arguments: Any) -> Any:
        near = [
            value * (1.0 + 1e-12 * rng.standard_normal(value.shape)) if _can_shake(value) else value
            for value in arguments
        ]
        return function(*near)

    return called


@contextmanager
def _time_limit() -> Iterator[None]:
    """Stop what takes more than CPU_SECONDS, in a main thread with alarms.

    The processor's time, so that a busy machine makes the same library.
    """
    usable = hasattr(signal, "setitimer") and threading.current_thread() is threading.main_thread()
    if not usable:
        yield
        return

    def stop(*_: object) -> None:
        raise _TooLongError

    before: Callable[..., Any] | int | None = signal.signal(signal.SIGPROF, stop)
    signal.setitimer(signal.ITIMER_PROF, CPU_SECONDS)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_PROF, 0.0)
        signal.signal(signal.SIGPROF, before)


@contextmanager
def _memory_limit() -> Iterator[None]:
    """A mistake that builds a huge list fails with MemoryError instead of filling the machine."""
    try:
        import resource

        taken = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
    except (ImportError, OSError):
        yield
        return
    before = resource.getrlimit(resource.RLIMIT_AS)
    resource.setrlimit(resource.RLIMIT_AS, (taken + MEMORY, before[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_AS, before)
