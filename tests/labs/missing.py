"""Run a lab's notebook in this process with functions missing, and say which cells need which."""

import ast
import os
import sys
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import ModuleType

from falconwing_kit.tools.grading.find import importable_given, load_module
from falconwing_kit.tools.grading.notebooks import SourceCell, read_cells


@dataclass(frozen=True)
class Ran:
    """A code cell after it ran.

    Attributes:
        number: in the source.
        cell: its source.
        printed: what it printed.
        error: name of the exception that the kernel reports; empty where it reports none.
    """

    number: int
    cell: SourceCell
    printed: str
    error: str


def run_without(
    folder: Path,
    missing: Iterable[str],
    patch: Mapping[str, str],
    cells: Sequence[SourceCell] | None = None,
) -> list[Ran]:
    """The code cells of a lab, run one after the other whatever happens, as "Run all" does.

    Args:
        folder: the lab's.
        missing: exercises that are left as handed out; the others are solved.
        patch: text in the cells -> what runs in its place, where a lab takes minutes.
        cells: to run in place of the lab's own.
    """
    from IPython.core.interactiveshell import InteractiveShell
    from IPython.utils.capture import capture_output

    from falconwing_kit.tools.grading import stopped

    main, before, stopped_shell, ran = sys.modules["__main__"], Path.cwd(), stopped._shell, []
    shell = InteractiveShell(user_module=ModuleType("__main__"))
    shell.run_line_magic("colors", "nocolor")
    os.chdir(folder)
    stopped._shell = lambda: shell
    try:
        with importable_given(load_module(folder, "given")):
            for number, cell in enumerate(cells or read_cells(folder / "lab.py")):
                if cell.markdown or cell.solution_only:
                    continue
                code = cell.for_student() if cell.name in missing else cell.for_solution()
                for old, new in patch.items():
                    code = code.replace(old, new)
                with capture_output() as out:
                    result = shell.run_cell(code)
                error = result.error_before_exec or result.error_in_exec
                ran.append(Ran(number, cell, out.stdout, type(error).__name__ if error else ""))
    finally:
        os.chdir(before)
        stopped._shell, sys.modules["__main__"] = stopped_shell, main
    return ran


def cells_that_need(folder: Path, function: str) -> set[int]:
    """Cells that need a function: they name it, or anything that such a cell makes.

    Too many rather than too few: a name counts whether or not it is used when the cell runs.
    """
    needs, names = set(), {function}
    for number, cell in enumerate(read_cells(folder / "lab.py")):
        if (
            cell.markdown
            or cell.kind == "check"
            or (cell.kind, cell.name) == ("exercise", function)
        ):
            continue
        tree = ast.parse(cell.for_solution())
        for _ in range(3):  # functions of a cell that call each other
            for node in tree.body:
                if names & {each.id for each in ast.walk(node) if isinstance(each, ast.Name)}:
                    names |= _made(node)
                    needs.add(number)
        if number in needs and cell.kind != "exercise":
            names |= {name for node in tree.body for name in _made(node)}
    return needs


def _made(node: ast.stmt) -> set[str]:
    """Names that a statement makes or changes."""
    if isinstance(node, ast.FunctionDef | ast.ClassDef):
        return {node.name}
    if isinstance(node, ast.Import | ast.ImportFrom):
        return set()
    stored = {
        each.id
        for each in ast.walk(node)
        if isinstance(each, ast.Name) and isinstance(each.ctx, ast.Store)
    }
    changed = {
        each.value.id
        for each in ast.walk(node)
        if isinstance(each, ast.Subscript | ast.Attribute)
        and isinstance(each.ctx, ast.Store)
        and isinstance(each.value, ast.Name)
    }
    return stored | changed
