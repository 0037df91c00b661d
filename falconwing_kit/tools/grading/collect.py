"""Collector: a student's notebook -> the source text of one function, without running anything.

The function is found by its name in any code cell, so cells may be split, copied or moved. Its
dependencies are collected transitively: functions, classes, imports and simple assignments of the
notebook. The last definition of a name counts, as in a run from top to bottom.
"""

import ast
import builtins
import json
import re
import symtable
import sys
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any

from falconwing_kit.core.checks import InputError, require_file
from falconwing_kit.tools.grading.bounded import TooMuchError, call_bounded

MAX_FILE, MAX_CODE = 32 << 20, 2 << 20  # bytes of a notebook with its outputs, and of its code
MAX_PIECES = 5_000_000  # commas and brackets in the file, which limit the parser's memory
MAX_CELLS = 10_000
COLLECT_S, COLLECT_MIB = 3.0, 1024  # limits of reading a notebook's code; a lab's takes 0.02 s
MAX_PROBLEMS = 8
KIT_KEY = "falconwing_kit"  # metadata key of the kit's version that built the notebook
COURSE_KEY = "falconwing_course"  # of the mark of the course
_KNOWN = frozenset(dir(builtins)) | {"__name__", "__file__"}
_VERSION = re.compile(r"(\d{1,4})\.(\d{1,4})")
_VERSION_BELOW_TITLE = re.compile(
    r"^\*Notebook of falconwing-kit (\d{1,4}\.\d{1,4})\.\*$", re.MULTILINE
)
_HELP = re.compile(r"[\w. ]+\?{1,2}")


@dataclass(frozen=True)
class SubmittedCell:
    """A cell of a student's notebook.

    Attributes:
        code: whether it is a code cell; otherwise it is text.
        text: its source.
        role: "exercise", "check", "figure", "answer" or "quiz"; else empty. Not trusted.
        name: of the exercise, figure or answer.
    """

    code: bool
    text: str
    role: str = ""
    name: str = ""


@dataclass(frozen=True)
class Notebook:
    """A student's notebook, read but not run.

    Attributes:
        cells: in the notebook's order.
        kit: version of the kit that built it; not stored before 0.2.
        course: mark of the course that it was handed out in; empty for the open course.
    """

    cells: tuple[SubmittedCell, ...]
    kit: str = "0.1"
    course: str = ""

    @property
    def code(self) -> tuple[str, ...]:
        """Texts of the code cells."""
        return tuple(cell.text for cell in self.cells if cell.code)


@dataclass(frozen=True)
class Source:
    """A function with its dependencies, as Python text.

    Attributes:
        text: empty if the notebook does not define the function.
        problems: messages for the student.
    """

    text: str
    problems: tuple[str, ...] = ()


@dataclass(frozen=True)
class _Statement:
    """A top-level statement: the names that it binds and the notebook's names that it needs."""

    node: ast.stmt
    binds: frozenset[str]
    needs: frozenset[str]
    kept: bool  # whether its kind is collected

    @property
    def is_stub(self) -> bool:
        """Whether it is unwritten: a function that only raises NotImplementedError, or a class
        with only such methods; docstrings do not count.
        """
        return _is_unwritten(self.node)


def read_notebook(path: str | Path) -> Notebook:
    """Read a notebook file.

    Raises:
        FileNotFoundError: there is no file.
        InputError: it is not a notebook, or too large.
    """
    file = require_file(path)
    with file.open("rb") as handle:
        return parse_notebook(handle.read(MAX_FILE + 1), file.name)


def parse_notebook(data: bytes, name: str) -> Notebook:
    """The cells of a notebook.

    Args:
        data: the file's bytes, untrusted.
        name: of the file, for messages.

    Raises:
        InputError: it is not a notebook, or too large.
    """
    if len(data) > MAX_FILE:
        raise InputError(
            f"{name}: expected a notebook of at most {MAX_FILE >> 20} MiB; "
            "clear its outputs and save it again"
        )
    if sum(map(data.count, (b",", b"[", b"{"))) > MAX_PIECES:
        raise InputError(
            f"{name}: the notebook holds millions of values; clear its outputs and save it"
        )
    try:
        content = json.loads(data.decode("utf-8-sig"))
    except (ValueError, RecursionError, MemoryError):
        raise InputError(
            f"{name}: expected a Jupyter notebook, got "
            f"{'a file that is not one' if data.strip() else 'an empty file'}; save it again"
        ) from None
    cells = content.get("cells") if isinstance(content, dict) else None
    if not isinstance(cells, list):
        raise InputError(
            f"{name}: expected a notebook with cells, as Jupyter saves it today, got none; "
            "save it again"
        )
    if len(cells) > MAX_CELLS:
        raise InputError(f"{name}: expected at most {MAX_CELLS} cells, got {len(cells)}")
    read = tuple(_read_cell(cell) for cell in cells if isinstance(cell, dict))
    metadata = content.get("metadata")
    course = metadata.get(COURSE_KEY) if isinstance(metadata, dict) else None
    mark = course[:64] if isinstance(course, str) else ""
    notebook = Notebook(read, _kit_of(metadata, read), mark)
    if sum(len(cell.text) for cell in notebook.cells) > MAX_CODE:
        raise InputError(
            f"{name}: expected at most {MAX_CODE >> 20} MiB of text in the cells; "
            "take large data out of them"
        )
    return notebook


def require_notebook_of(notebook: Notebook, since: str, name: str) -> None:
    """Raise InputError if a notebook is older than `since`.

    Args:
        notebook: the student's.
        since: the lab's `notebook_since`; empty for any.
        name: of the file, for the message.
    """
    if since and _numbers(notebook.kit) < _numbers(since):
        raise InputError(
            f"{name}: expected a notebook of falconwing-kit {since}, got one of {notebook.kit}: "
            "download the new notebook and copy your answers over"
        )


def _numbers(version: str) -> tuple[int, ...]:
    return tuple(map(int, version.split(".")[:2]))


def _kit_of(metadata: Any, cells: Iterable[SubmittedCell]) -> str:
    """The kit's version, from the metadata or from the line below the title."""
    written = metadata.get(KIT_KEY) if isinstance(metadata, dict) else None
    if isinstance(written, str) and _VERSION.fullmatch(written):
        return written
    lines = (_VERSION_BELOW_TITLE.search(cell.text) for cell in cells if not cell.code)
    return next((line[1] for line in lines if line), Notebook.kit)


def collect_sources(
    notebook: Notebook, names: Sequence[str], packages: Iterable[str] = ("numpy",)
) -> dict[str, Source]:
    """Sources of several functions, with bounded time and memory, whatever the notebook holds.

    Args:
        notebook: the student's.
        names: of the functions.
        packages: as in `collect_source`.

    Raises:
        InputError: reading the code takes more than COLLECT_S of computing or COLLECT_MIB.
    """
    allowed = tuple(packages)

    def collect() -> list[tuple[str, tuple[str, ...]]]:
        found = [collect_source(notebook, name, allowed) for name in names]
        return [(each.text, each.problems) for each in found]

    try:
        found = call_bounded(collect, COLLECT_S, COLLECT_MIB)
    except TooMuchError:
        raise InputError(
            f"expected code that is read within {COLLECT_S:g} s and {COLLECT_MIB} MiB, got more; "
            "take large data and very long lines out of the cells"
        ) from None
    return {
        name: Source(text, tuple(problems))
        for name, (text, problems) in zip(names, found, strict=True)
    }


def collect_source(notebook: Notebook, name: str, packages: Iterable[str] = ("numpy",)) -> Source:
    """The text of a function with all its dependencies in the notebook.

    Args:
        notebook: the student's.
        name: of the function.
        packages: that it may import, beside `given` and the standard library.

    Returns:
        Text to run in the sandbox, and its problems; never raises, whatever the notebook holds.
    """
    statements, found = _statements(notebook)
    problems = list(found)
    written = [each for each in statements if each.kept and name in each.binds and not each.is_stub]
    if len(written) > 1:
        problems.append(f"{name} is written {len(written)} times; the last one counts")
    if not any(each.kept and name in each.binds for each in statements):
        return Source("", _first((f"no code cell defines {name}", *problems)))
    chosen, missing = _closure(statements, name)
    allowed = {*packages, "given", *sys.stdlib_module_names}
    lines = []
    for each in chosen:
        foreign = sorted(_imported(each.node) - allowed)
        problems += [f"{name} uses {module}, which the grader does not have" for module in foreign]
        if not (foreign and isinstance(each.node, ast.Import | ast.ImportFrom)):
            lines.append(ast.unparse(each.node))
    defined = frozenset().union(*(each.binds for each in statements))
    for lost in sorted(missing):
        where = "inside an if, for, with or try" if lost in defined else "nowhere in the notebook"
        problems.append(
            f"{name} uses {lost}, which is defined {where}; the grader does not have it"
        )
    return Source("\n".join(lines) + "\n", _first(problems))


def written_statements(notebook: Notebook) -> Iterator[tuple[ast.stmt, str]]:
    """Top-level statements of the code cells that are Python, each with its text as typed.

    Comment lines directly above a statement belong to its text; `import a, b` is two statements.
    """
    for text in notebook.code:
        try:
            body = parse_cell(text).body
        except (SyntaxError, ValueError, RecursionError, MemoryError):
            continue
        lines = text.split("\n")
        for node in body:
            decorators = getattr(node, "decorator_list", ())
            first = min([node.lineno, *(each.lineno for each in decorators)]) - 1
            while first and lines[first - 1].startswith("#") and "# %%" not in lines[first - 1]:
                first -= 1
            typed = "\n".join(lines[first : node.end_lineno])
            for part in _split(node):
                yield part, typed if part is node else ast.unparse(part)


def _first(problems: Iterable[str]) -> tuple[str, ...]:
    return tuple(problem[:200] for problem in dict.fromkeys(problems))[:MAX_PROBLEMS]


def _read_cell(cell: dict[str, Any]) -> SubmittedCell:
    """A cell of the file; malformed parts count as empty."""
    source, metadata = cell.get("source", ""), cell.get("metadata")
    if isinstance(source, list):
        source = "".join(line for line in source if isinstance(line, str))
    text = source if isinstance(source, str) else ""
    marks = metadata if isinstance(metadata, dict) else {}
    role = next(
        (
            each
            for each in ("exercise", "check", "figure", "answer", "quiz")
            if isinstance(marks.get(each), str)
        ),
        "",
    )
    return SubmittedCell(
        cell.get("cell_type") == "code",
        text.replace("\r\n", "\n"),
        role,
        marks.get(role, "") if role else "",
    )


@lru_cache(maxsize=1)  # one notebook's functions are collected one after the other
def _statements(notebook: Notebook) -> tuple[tuple[_Statement, ...], tuple[str, ...]]:
    """Top-level statements of all code cells, and the problems of cells that are not Python."""
    statements: list[_Statement] = []
    problems = []
    for number, text in enumerate(notebook.code, 1):
        try:
            statements += [
                _read_statement(part) for node in parse_cell(text).body for part in _split(node)
            ]
        except SyntaxError as error:
            problems.append(f"code cell {number} is not Python: line {error.lineno}")
        except (ValueError, RecursionError, MemoryError):
            problems.append(f"code cell {number} is not Python that the grader can read")
    return tuple(statements), tuple(problems)


def broken_cells(notebook: Notebook) -> list[tuple[str, str]]:
    """The code cells that are not Python: their text, and one sentence with the line."""
    found = []
    for number, text in enumerate(notebook.code, 1):
        try:
            parse_cell(text)
        except SyntaxError as error:
            line = " ".join((error.text or "").split())[:80]
            words = f"code cell {number} is not Python: line {error.lineno}, {error.msg}: {line}"
            found.append((text, words))
        except (ValueError, RecursionError, MemoryError):
            found.append((text, f"code cell {number} is not Python that can be read"))
    return found


def parse_cell(text: str) -> ast.Module:
    """A cell's syntax tree, without IPython's own lines (`%matplotlib`, `!ls`, `name?`)."""
    try:
        return ast.parse(text)
    except SyntaxError:
        if text.lstrip().startswith("%%") and not text.lstrip().startswith(("%%time", "%%capture")):
            return ast.Module([], [])  # a cell in another language
        return ast.parse("\n".join(map(_without_magic, text.split("\n"))))


def _without_magic(line: str) -> str:
    """A line of Python, or `pass` in the place of a line of IPython.

    The time is linear in the line's length: the whole line matches `_HELP`, from its first
    character on, or not.
    """
    command = line.strip(" \t")
    if command[:1] in ("%", "!", "?") or (command[-1:] == "?" and _HELP.fullmatch(command)):
        return line[: len(line) - len(line.lstrip(" \t"))] + "pass"
    return line


def _split(node: ast.stmt) -> list[ast.stmt]:
    """A statement, or one import per module."""
    return [ast.Import([alias]) for alias in node.names] if isinstance(node, ast.Import) else [node]


def _read_statement(node: ast.stmt) -> _Statement:
    kept = isinstance(
        node,
        ast.FunctionDef
        | ast.ClassDef
        | ast.Import
        | ast.ImportFrom
        | ast.Assign
        | ast.AnnAssign
        | ast.AugAssign,
    )
    return _Statement(node, frozenset(_bound(node)), frozenset(_needed(node)), kept)


def _bound(node: ast.stmt) -> Iterator[str]:
    """Names that a statement binds; `a[0] = 1` and `a.b = 1` count for a."""
    if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef | ast.ClassDef):
        yield node.name
    elif isinstance(node, ast.Import | ast.ImportFrom):
        yield from ((alias.asname or alias.name.split(".")[0]) for alias in node.names)
    else:
        targets = node.targets if isinstance(node, ast.Assign) else [getattr(node, "target", node)]
        for inner in (each for target in targets for each in ast.walk(target)):
            if isinstance(inner, ast.Name) and isinstance(inner.ctx, ast.Store):
                yield inner.id
        for target in targets:
            while isinstance(target, ast.Subscript | ast.Attribute):
                target = target.value
            if isinstance(target, ast.Name):
                yield target.id


def _needed(node: ast.stmt) -> Iterator[str]:
    """Free names of a statement, its inner functions included."""
    waiting = [symtable.symtable(ast.unparse(node), "cell", "exec")]
    while waiting:
        table = waiting.pop()
        waiting += table.get_children()
        for symbol in table.get_symbols():
            if symbol.is_global() or (table.get_type() == "module" and symbol.is_referenced()):
                yield symbol.get_name()


def _closure(statements: Sequence[_Statement], name: str) -> tuple[list[_Statement], set[str]]:
    """Statements that a name needs, in the notebook's order, and the undefined names."""
    stubs = {id(each) for each in statements if each.is_stub}
    binding: dict[str, list[_Statement]] = {}  # by name; unwritten functions only where no other is
    for ours in ([s for s in statements if id(s) not in stubs], statements):
        known = set(binding)
        for each in ours:
            for bound in each.binds - known if each.kept else ():
                binding.setdefault(bound, []).append(each)
    always = [each for each in statements if each.kept and _imports_all(each.node)]
    waiting, seen, missing = {name}.union(*(each.needs for each in always)), set(_KNOWN), set()
    chosen = {id(each) for each in always}
    while waiting:
        needed = waiting.pop()
        seen.add(needed)
        found = binding.get(needed, [])
        chosen.update(id(each) for each in found)
        for each in found:
            waiting |= each.needs - seen
        if not found:
            missing.add(needed)
    in_order = [each for each in statements if id(each) in chosen]
    stars = any("*" in each.binds for each in in_order)  # where a missing name may come from
    return sorted(in_order, key=lambda each: not _is_future(each.node)), set() if stars else missing


def _imports_all(node: ast.stmt) -> bool:
    """Whether it is an import for the whole notebook: `from given import *`, `from __future__`."""
    return isinstance(node, ast.ImportFrom) and (node.names[0].name == "*" or _is_future(node))


def _is_future(node: ast.stmt) -> bool:
    return isinstance(node, ast.ImportFrom) and node.module == "__future__"


def _imported(node: ast.stmt) -> set[str]:
    """Top-level modules that a statement imports, its inner functions included."""
    modules = set()
    for inner in ast.walk(node):
        if isinstance(inner, ast.Import):
            modules |= {alias.name.split(".")[0] for alias in inner.names}
        elif isinstance(inner, ast.ImportFrom):
            modules.add((inner.module or ".").split(".")[0] if not inner.level else ".")
    return modules


def _is_unwritten(node: ast.stmt) -> bool:
    """Whether a definition is as it was handed out."""
    if not isinstance(node, ast.FunctionDef | ast.ClassDef):
        return False
    body = [
        each for each in node.body if not (isinstance(each, ast.Expr) and _is_constant(each.value))
    ]
    if isinstance(node, ast.ClassDef):
        methods = [each for each in body if isinstance(each, ast.FunctionDef)]
        return len(methods) == len(body) > 0 and all(map(_is_unwritten, methods))
    return (
        len(body) == 1
        and isinstance(body[0], ast.Raise)
        and "NotImplementedError" in ast.dump(body[0])
    )


def _is_constant(node: ast.expr) -> bool:
    return isinstance(node, ast.Constant)
