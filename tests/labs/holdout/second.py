"""Second hold-out for the hints: a lab's solutions -> wrong functions of several tokens.

    python tests/labs/holdout/second.py      # writes second.json: which edits were drawn

The first list (generate.py) was looked at by class while the hints were made better; this one was
drawn before that and is only measured on. Each wrong function is one idea that changes two tokens
or more: an edit of the first list's generator that the first list does not hold, or one that
generate.py has not: the same edit wherever the expression stands, two names exchanged everywhere,
two steps or two cases exchanged, a sum that is not kept, a loop that ends after its first round.
"""

import ast
import copy
import io
import json
import signal
import sys
import tokenize
from collections.abc import Iterator
from difflib import SequenceMatcher
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[3]))
from falconwing_kit.tools.grading.find import lab_folders
from falconwing_kit.tools.grading.public_checks import exercise_state, run_checks
from tests.labs.functions import ROOT, LabHere
from tests.labs.holdout.generate import (
    _function,
    _too_long,
    as_function,
    edits,
    frozen,
    solution_source,
    wrong_sources,
)

SECOND = Path(__file__).parent / "second.json"
SEED, PER_EXERCISE, SECONDS = 22, 5, 4
ONE_PLACE = 2  # at most, of an exercise's wrong functions, are edits of generate.py in one place


def ideas(tree: ast.FunctionDef) -> Iterator[tuple[str, str, ast.FunctionDef]]:
    """Kind, words and function of each idea that generate.py has not; copy the function at once."""
    yield from _everywhere(tree)
    for finder in (_names, _steps):  # which change it, and turn it back afterwards
        for kind, cause in finder(tree):
            yield kind, cause, tree


def _everywhere(tree: ast.FunctionDef) -> Iterator[tuple[str, str, ast.FunctionDef]]:
    """An edit made at all nodes with the same expression."""
    found = [(kind, cause) for kind, cause, old, _ in edits(tree) if isinstance(old, ast.expr)]
    for key in dict.fromkeys(found):
        if found.count(key) > 1:
            changed = copy.deepcopy(tree)
            for kind, cause, old, new in list(edits(changed)):
                if (kind, cause) == key:
                    _swap(changed, old, new)
            yield f"{key[0]}, everywhere", key[1], changed


def _swap(tree: ast.AST, old: ast.AST, new: ast.AST) -> None:
    for parent in ast.walk(tree):
        for field, value in ast.iter_fields(parent):
            if value is old:
                setattr(parent, field, new)
                return
            if isinstance(value, list):
                for i, each in enumerate(value):
                    if each is old:
                        value[i] = new
                        return


def _names(tree: ast.FunctionDef) -> Iterator[tuple[str, str]]:
    """Two arguments, or two names that were set together, exchanged wherever they are read."""
    groups = [[each.arg for each in tree.args.args]]
    groups += [
        [each.id for each in node.elts if isinstance(each, ast.Name)]
        for node in ast.walk(tree)
        if isinstance(node, ast.Tuple) and isinstance(node.ctx, ast.Store)
    ]
    reads = [n for n in ast.walk(tree) if isinstance(n, ast.Name) and isinstance(n.ctx, ast.Load)]
    pairs = [(a, b) for group in groups for i, a in enumerate(group) for b in group[i + 1 :]]
    for a, b in dict.fromkeys(pairs):
        other = {a: b, b: a}
        for _ in range(2):  # there, and back after it was taken
            for node in reads:
                node.id = other.get(node.id, node.id)
            if _ == 0:
                yield "names exchanged", f"{a} and {b} exchanged everywhere"


def _steps(tree: ast.FunctionDef) -> Iterator[tuple[str, str]]:
    for node in list(ast.walk(tree)):
        for field in ("body", "orelse"):
            block = getattr(node, field, None)
            if not isinstance(block, list):
                continue
            for i in range(len(block) - 1):
                if not isinstance(block[i + 1], ast.Return):
                    block[i], block[i + 1] = block[i + 1], block[i]
                    yield "steps exchanged", f"'{_line(block[i])}' before '{_line(block[i + 1])}'"
                    block[i], block[i + 1] = block[i + 1], block[i]
            for i, each in enumerate(block):
                if isinstance(each, ast.AugAssign):
                    block[i] = ast.Assign([each.target], each.value, lineno=each.lineno)
                    yield "not kept", f"'{_line(each)}' sets, does not add"
                    block[i] = each
        if isinstance(node, ast.If | ast.IfExp) and node.orelse:
            node.body, node.orelse = node.orelse, node.body
            yield "cases exchanged", f"the cases of '{ast.unparse(node.test)}' exchanged"
            node.body, node.orelse = node.orelse, node.body
        if isinstance(node, ast.For):
            node.body.append(ast.Break())
            yield "one round", f"'{_line(node)}' ends after its first round"
            node.body.pop()


def _line(node: ast.AST) -> str:
    return ast.unparse(node).splitlines()[0]


def second_sources(source: str, name: str) -> list[tuple[str, str, str]]:
    """Kind, cause and text of each wrong form of the function `name`, in a fixed order."""
    found = wrong_sources(source, name)
    tree = ast.parse(source)
    place = tree.body.index(_function(tree, name))
    for kind, cause, function in ideas(_function(tree, name)):
        program = ast.Module([*tree.body[:place], function, *tree.body[place + 1 :]], [])
        found.append((kind, cause, ast.unparse(ast.fix_missing_locations(copy.deepcopy(program)))))
    return found


def tokens(text: str, name: str) -> list[str]:
    """Tokens of a program's function without brackets, line ends and indents."""
    text = ast.unparse(_function(ast.parse(text), name))
    every = tokenize.generate_tokens(io.StringIO(text).readline)
    return [each.string for each in every if each.string.strip("() \n")]


def tokens_changed(before: list[str], after: list[str]) -> int:
    """How many tokens were replaced, put in or left out."""
    steps = SequenceMatcher(None, before, after, autojunk=False).get_opcodes()
    return sum(max(i2 - i1, j2 - j1) for name, i1, i2, j1, j2 in steps if name != "equal")


def second() -> list[dict[str, str]]:
    """The second frozen list: lab, exercise, index, kind, cause."""
    return json.loads(SECOND.read_text(encoding="utf-8"))["wrong"]


def draw() -> None:
    """Draw the list: of which a public check sees that they are wrong."""
    signal.signal(signal.SIGALRM, _too_long)
    known = {(row["exercise"], row["kind"], row["cause"]) for row in frozen()}
    listed = {row["exercise"] for row in frozen()}
    rows = []
    for folder in lab_folders(ROOT / "labs"):
        here = LabHere(folder)
        for exercise in [each for each in here.lab.exercises if each.name in listed]:
            name, kept, seen, one_place = exercise.name, [], set(), 0
            source = solution_source(here, name)
            wrong, right = second_sources(source, name), tokens(source, name)
            of_first = {each[:2] for each in wrong_sources(source, name)}
            for index in np.random.default_rng([SEED, *name.encode()]).permutation(len(wrong)):
                kind, cause, text = wrong[index]
                if (name, kind, cause) in known or text in seen:
                    continue
                if tokens_changed(right, tokens(text, name)) < 2:
                    continue
                if (kind, cause) in of_first and one_place == ONE_PLACE:
                    continue
                signal.alarm(SECONDS)
                try:
                    state = exercise_state(run_checks(exercise, as_function(here, name, text)))
                except BaseException:
                    continue
                finally:
                    signal.alarm(0)
                if state == "failed":
                    seen.add(text)
                    one_place += (kind, cause) in of_first
                    kept.append(
                        {"lab": folder.name, "exercise": name, "index": int(index)}
                        | {"kind": kind, "cause": cause}
                    )
                if len(kept) == PER_EXERCISE:
                    break
            rows += kept
            print(name, len(wrong), len(kept), flush=True)
    record = {"seed": SEED, "count": len(rows), "wrong": rows}
    SECOND.write_text(json.dumps(record, indent=0) + "\n", encoding="utf-8")
    print(len(rows), "wrong functions of two tokens or more")


if __name__ == "__main__":
    draw()
