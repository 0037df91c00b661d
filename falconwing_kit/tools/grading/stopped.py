"""Missing functions in a notebook: what a cell raised -> one sentence, and the next cells run.

In the first cell of a lab:

    from falconwing_kit.tools.grading import keep_going

    keep_going()

From then on a cell that calls a function that is not written says so in one sentence. Where a
function raises something else, its traceback is shown as always, with that sentence below. "Run all
cells" goes on in both cases, so that the other figures are drawn. Any other error stops as always.

    borrow("min_speed")

draws the figures of a function that is stuck with the kit's; every cell that uses it says so. It
gives no points: the grader takes what is written in the notebook.
"""

import ast
import functools
from collections.abc import Callable, Iterator, Sequence
from typing import Any

from falconwing_kit.core.checks import InputError
from falconwing_kit.tools.grading.mine import PARTS, load_parts
from falconwing_kit.tools.grading.public_checks import lab_here

NOTEBOOK = "__main__"  # the module that a notebook's cells run in


def keep_going() -> None:
    """Let the cells of this notebook go on after one that needs a missing function.

    Outside of a notebook it does nothing.
    """
    shell = _shell()
    if shell is None:
        return
    before = _cells_of(shell)
    if before is not None:  # the first cell, run again
        shell.events.unregister("pre_run_cell", before.begin)
        shell.events.unregister("post_run_cell", before.end)
    cells = _Cells(shell)
    shell.events.register("pre_run_cell", cells.begin)
    shell.events.register("post_run_cell", cells.end)
    shell.set_custom_exc((Exception,), cells.explain)


def borrow(name: str) -> None:
    """Use the kit's function in this notebook until the exercise's own cell is run again.

    Args:
        name: of an exercise of this lab.

    Raises:
        InputError: it is none, or this lab's functions are no part of `my_falconwing`.
    """
    lab = lab_here()[1]
    names = [exercise.name for exercise in lab.exercises]
    part = next((part.module for part in PARTS if part.lab == lab.name), "")
    if name not in names or not part:
        what = ", ".join(names) if part else f"a lab before {lab.name}"
        raise InputError(f"borrow: expected one of {what}, got {name}")
    shell = _shell()
    cells = None if shell is None else _cells_of(shell)
    if cells is None:
        raise InputError("borrow: expected a notebook with keep_going() in it; run its first cells")
    kits: Callable[..., Any] = getattr(getattr(load_parts("kit"), part), name)

    @functools.wraps(kits)
    def borrowed(*arguments: Any, **named: Any) -> Any:
        cells.used.add(name)
        return kits(*arguments, **named)

    borrowed.is_borrowed = True  # type: ignore[attr-defined]  # `check` must not call it yours
    shell.user_ns[name] = borrowed
    print(f"{name} is the kit's now; run the cells below again")


class _Cells:
    """The cells of one notebook as they run.

    Attributes:
        shell: IPython's.
        missing: names that a stopped cell would have made -> the function that it needed.
        used: borrowed functions that this cell has called.
    """

    def __init__(self, shell: Any) -> None:
        self.shell = shell
        self.missing: dict[str, str] = {}
        self.used: set[str] = set()
        self._code, self._goes_on = "", False

    def begin(self, info: Any) -> None:
        """Before a cell."""
        self._code, self._goes_on = info.raw_cell, False
        self.used.clear()

    def explain(
        self, shell: Any, kind: type, error: BaseException, trace: Any, tb_offset: int | None = None
    ) -> None:
        """In place of IPython's report of an exception."""
        names = _exercises()
        inside = [name for name in _functions(trace) if name in names]
        if isinstance(error, NameError) and error.name in self.missing:
            function = self.missing[error.name]
            print(
                f"This cell needs `{error.name}` of a cell above, and that one needs your "
                f"{function}. Cells that do not need it go on."
            )
        elif isinstance(error, NotImplementedError) and inside:
            function = inside[-1]
            print(
                f"This cell needs your {function}, which is not written yet. "
                f'Cells that do not need it go on; borrow("{function}") goes on with the kit\'s.'
            )
        elif inside:
            function = inside[-1]
            shell.showtraceback((kind, error, trace), tb_offset=tb_offset)
            print(
                f"This cell ended in your {function}, as shown above. "
                "Cells that do not need it go on."
            )
        else:
            shell.showtraceback((kind, error, trace), tb_offset=tb_offset)
            return
        self._goes_on = True
        made = set(_bound_names(self._code)) - set(shell.user_ns)
        self.missing |= dict.fromkeys(made, function)

    def end(self, result: Any) -> None:
        """After a cell: the kernel is not told of an error that has been explained."""
        if self.used:
            print(f"drawn with the kit's {', '.join(sorted(self.used))}")
        if self._goes_on:
            result.error_in_exec = None
        for name in list(self.missing):
            if name in self.shell.user_ns:
                del self.missing[name]


def _cells_of(shell: Any) -> _Cells | None:
    """The cells that `keep_going` watches in a shell."""
    found = (getattr(each, "__self__", None) for each in shell.events.callbacks["pre_run_cell"])
    return next((each for each in found if isinstance(each, _Cells)), None)


def _shell() -> Any:
    """IPython's shell, or None."""
    try:
        from IPython.core.getipython import get_ipython
    except ModuleNotFoundError:
        return None
    return get_ipython()


def _exercises() -> Sequence[str]:
    """Names of the functions of the lab in this folder; none where it cannot be read."""
    try:
        return [exercise.name for exercise in lab_here()[1].exercises]
    except Exception:  # the student's own error is what must be shown
        return []


def _functions(trace: Any) -> Iterator[str]:
    """The notebook's functions and classes in an exception's trace, the outermost first."""
    while trace is not None:
        frame = trace.tb_frame
        if frame.f_globals.get("__name__") == NOTEBOOK:
            yield frame.f_code.co_qualname.split(".")[0]  # a method counts as its class
        trace = trace.tb_next


def _bound_names(code: str) -> Iterator[str]:
    """Names that a cell's statements make at its top level, in loops and branches too."""
    try:
        statements: list[ast.AST] = list(ast.parse(code).body)
    except SyntaxError:
        return
    while statements:
        node = statements.pop()
        if isinstance(node, ast.FunctionDef | ast.ClassDef | ast.AsyncFunctionDef):
            yield node.name
        elif isinstance(node, ast.Import | ast.ImportFrom):
            yield from ((each.asname or each.name).split(".")[0] for each in node.names)
        elif isinstance(node, ast.Name) and isinstance(node.ctx, ast.Store):
            yield node.id
        else:
            statements += ast.iter_child_nodes(node)
