"""Hold-out for the hints: a lab's solutions -> wrong functions with their true cause.

    python tests/labs/holdout/generate.py      # writes frozen.json: which edits were drawn

Each wrong function is one edit of the solution's syntax tree. `frozen.json` was written before the
hints and is not drawn again; a changed solution needs a new list and new figures. Nothing of the
list of mistakes that the hints know is used here.
"""

import ast
import copy
import json
import signal
import sys
from collections.abc import Iterator
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))
from functions import ROOT, LabHere

from falconwing_kit.tools.grading.collect import Notebook, SubmittedCell, collect_source
from falconwing_kit.tools.grading.find import importable_given, lab_folders
from falconwing_kit.tools.grading.lab import Function
from falconwing_kit.tools.grading.public_checks import exercise_state, run_checks

FROZEN = Path(__file__).parent / "frozen.json"
SEED, PER_EXERCISE, SECONDS = 21, 10, 4
LEFT_OUT = ("radians", "degrees", "sqrt", "exp", "log", "abs", "unwrap", "deg2rad", "inv", "cumsum")
LIMITS = ("maximum", "minimum", "clip", "nan_to_num", "where", "max", "min")
PAIRS = {"sin": "cos", "cos": "sin", "mean": "sum", "sum": "mean", "argmax": "argmin"}
SINGLE_TOKEN = {"sign of a term", "comparison", "axis", "constant", "other function"}


def edits(tree: ast.AST) -> Iterator[tuple[str, str, ast.AST, ast.AST]]:
    """All edits of a function: kind, the words for its cause, the old node, the new node."""
    for node in ast.walk(tree):
        text = ast.unparse(node) if isinstance(node, ast.expr) else ""
        if isinstance(node, ast.BinOp):
            left, right = ast.unparse(node.left), ast.unparse(node.right)
            if isinstance(node.op, ast.Add | ast.Sub):
                other = ast.Sub() if isinstance(node.op, ast.Add) else ast.Add()
                flipped = ast.BinOp(node.left, other, node.right)
                yield "sign of a term", f"{right} with the other sign", node, flipped
                yield "missing term", f"{right} left out", node, node.left
                if isinstance(node.op, ast.Sub):
                    swapped = ast.BinOp(node.right, node.op, node.left)
                    yield "sign of a difference", f"{right} minus {left}", node, swapped
                else:
                    yield "missing term", f"{left} left out", node, node.right
            elif isinstance(node.op, ast.Mult | ast.Div):
                yield "missing factor", f"{right} left out", node, node.left
                if isinstance(node.op, ast.Mult):
                    yield "missing factor", f"{left} left out", node, node.right
                else:
                    swapped = ast.BinOp(node.right, node.op, node.left)
                    yield "upside down", f"{right} over {left}", node, swapped
            elif isinstance(node.op, ast.MatMult):
                swapped = ast.BinOp(node.right, node.op, node.left)
                yield "wrong order", f"{right} before {left}", node, swapped
                turned = ast.BinOp(ast.Attribute(node.left, "T", ast.Load()), node.op, node.right)
                yield "transposed", f"{left} transposed", node, turned
                yield "missing factor", f"{left} left out", node, node.right
            elif isinstance(node.op, ast.Pow):
                yield "missing power", f"{left} without its power", node, node.left
        elif isinstance(node, ast.UnaryOp) and isinstance(node.op, ast.USub | ast.Invert):
            if not isinstance(node.operand, ast.Constant):
                yield "sign of a whole term", f"{text} with the other sign", node, node.operand
        elif isinstance(node, ast.Attribute) and node.attr == "T":
            yield "transposed", f"{text} not transposed", node, node.value
        elif isinstance(node, ast.Call):
            yield from _call_edits(node, text)
        elif isinstance(node, ast.Compare) and len(node.ops) == 1:
            other = {ast.Lt: ast.LtE, ast.LtE: ast.Lt, ast.Gt: ast.GtE, ast.GtE: ast.Gt}
            opposite = {ast.Lt: ast.Gt, ast.LtE: ast.GtE, ast.Gt: ast.Lt, ast.GtE: ast.LtE}
            for table, words in ((other, "at the limit itself"), (opposite, "the wrong way")):
                if type(node.ops[0]) in table:
                    new = ast.Compare(node.left, [table[type(node.ops[0])]()], node.comparators)
                    yield "comparison", f"{text} {words}", node, new
        elif isinstance(node, ast.BoolOp):
            for i, value in enumerate(node.values):
                rest = [each for k, each in enumerate(node.values) if k != i]
                new = rest[0] if len(rest) == 1 else ast.BoolOp(node.op, rest)
                yield "missing condition", f"{ast.unparse(value)} left out", node, new
        elif isinstance(node, ast.IfExp):
            yield "missing case", f"{ast.unparse(node.orelse)} never used", node, node.body
        elif isinstance(node, ast.Constant) and type(node.value) in (int, float):
            new = ast.Constant(node.value + 1 if type(node.value) is int else node.value * 2.0)
            yield "constant", f"{text} taken as {new.value}", node, new
        elif isinstance(node, ast.Slice) and (node.lower or node.upper):
            for name in ("lower", "upper"):
                if getattr(node, name):
                    new = copy.copy(node)
                    setattr(new, name, ast.BinOp(getattr(node, name), ast.Add(), ast.Constant(1)))
                    yield "off by one", f"{text} one later at its {name} end", node, new
        elif isinstance(node, ast.Return) and isinstance(node.value, ast.Tuple):
            items = node.value.elts
            if len(items) > 1:
                new = ast.Return(ast.Tuple([items[1], items[0], *items[2:]], ast.Load()))
                yield "swapped results", "first two results swapped", node, new
        elif isinstance(node, ast.Assign) and isinstance(node.targets[0], ast.Tuple):
            items = node.targets[0].elts
            if len(items) > 1:
                targets = ast.Tuple([items[1], items[0], *items[2:]], ast.Store())
                new = ast.Assign([targets], node.value, lineno=node.lineno)
                yield "swapped components", f"{ast.unparse(targets)} in this order", node, new
        if isinstance(node, ast.AugAssign | ast.Assign | ast.If | ast.For):  # noqa: SIM102
            if not (isinstance(node, ast.Assign) and isinstance(node.targets[0], ast.Tuple)):
                first = ast.unparse(node).splitlines()[0]
                yield "missing step", f"the step '{first}' left out", node, ast.Pass()


def _call_edits(node: ast.Call, text: str) -> Iterator[tuple[str, str, ast.AST, ast.AST]]:
    name = node.func.attr if isinstance(node.func, ast.Attribute) else ast.unparse(node.func)
    if name in LEFT_OUT and node.args:
        kind = "degrees for radians" if name in ("radians", "degrees", "deg2rad") else "no function"
        yield kind, f"{name} left out in {text}", node, node.args[0]
    if name in LIMITS and len(node.args) > 1:
        yield "missing limit", f"{text} without its limit", node, node.args[name == "where"]
    if name in PAIRS and isinstance(node.func, ast.Attribute):
        new = copy.copy(node)
        new.func = ast.Attribute(node.func.value, PAIRS[name], ast.Load())
        yield "other function", f"{PAIRS[name]} in place of {name}", node, new
    if len(node.args) == 2 and not any(isinstance(each, ast.Starred) for each in node.args):
        new = copy.copy(node)
        new.args = node.args[::-1]
        yield "swapped arguments", f"arguments of {text} swapped", node, new
    for keyword in node.keywords:
        new = copy.copy(node)
        if keyword.arg == "axis" and isinstance(keyword.value, ast.Constant):
            value = ast.Constant(0 if keyword.value.value else 1)
            new.keywords = [
                ast.keyword("axis", value) if each is keyword else each for each in node.keywords
            ]
            yield "axis", f"axis {value.value} in {text}", node, new
        else:
            new.keywords = [each for each in node.keywords if each is not keyword]
            yield "forgotten option", f"{keyword.arg} left out in {text}", node, new


class _Replace(ast.NodeTransformer):
    def __init__(self, old: ast.AST, new: ast.AST) -> None:
        self.old, self.new = old, new

    def visit(self, node: ast.AST) -> ast.AST:
        """The new node for the old one."""
        return copy.deepcopy(self.new) if node is self.old else super().generic_visit(node)


def wrong_sources(source: str, name: str) -> list[tuple[str, str, str]]:
    """Kind, cause and text of each wrong form of the function `name` in a program."""
    count = sum(1 for _ in edits(_function(ast.parse(source), name)))
    found = []
    for index in range(count):
        tree = ast.parse(source)
        kind, cause, old, new = list(edits(_function(tree, name)))[index]
        wrong = ast.fix_missing_locations(_Replace(old, new).visit(tree))
        found.append((kind, cause, ast.unparse(wrong)))
    return found


def _function(tree: ast.Module, name: str) -> ast.FunctionDef:
    return next(
        node for node in tree.body if isinstance(node, ast.FunctionDef) and node.name == name
    )


def solution_source(here: LabHere, name: str) -> str:
    """The program that the grader's collector takes from the solution."""
    cells = tuple(SubmittedCell(True, cell.for_solution()) for cell in here.cells)
    return collect_source(Notebook(cells), name, here.lab.packages).text


def as_function(here: LabHere, name: str, text: str) -> Function:
    """A program's function, as the checks call it."""
    namespace: dict[str, object] = {"__name__": "notebook"}
    with importable_given(here.given):
        exec(compile(text, name, "exec"), namespace)
    return here.as_called(name, namespace[name])


def frozen() -> list[dict[str, str]]:
    """The frozen list: lab, exercise, index of the edit, kind, cause."""
    return json.loads(FROZEN.read_text(encoding="utf-8"))["wrong"]


def _too_long(*_: object) -> None:
    raise BaseException("too long")


def draw() -> None:
    """Draw the list: edits of which a public check sees that they are wrong."""
    signal.signal(signal.SIGALRM, _too_long)
    rows = []
    for folder in lab_folders(ROOT / "labs"):
        here = LabHere(folder)
        for exercise in here.lab.exercises:
            name = exercise.name
            wrong = wrong_sources(solution_source(here, name), name)
            rng = np.random.default_rng([SEED, *name.encode()])
            order, kept = list(rng.permutation(len(wrong))), []
            order.sort(key=lambda i: wrong[i][0] in SINGLE_TOKEN and rng.random() < 0.6)
            for index in order:
                kind, cause, text = wrong[index]
                signal.alarm(SECONDS)
                try:
                    state = exercise_state(run_checks(exercise, as_function(here, name, text)))
                except BaseException:
                    continue
                finally:
                    signal.alarm(0)
                if state == "failed":
                    kept.append(
                        {"lab": folder.name, "exercise": name, "index": int(index)}
                        | {"kind": kind, "cause": cause}
                    )
                if len(kept) == PER_EXERCISE:
                    break
            rows += kept
            print(name, len(wrong), len(kept), flush=True)
    single = sum(row["kind"] in SINGLE_TOKEN for row in rows)
    record = {"seed": SEED, "count": len(rows), "single_token": single, "wrong": rows}
    FROZEN.write_text(json.dumps(record, indent=0) + "\n", encoding="utf-8")
    print(len(rows), "wrong functions,", single, "of a single token")


if __name__ == "__main__":
    draw()
