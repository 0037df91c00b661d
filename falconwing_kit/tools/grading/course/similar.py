"""Code similarity: the functions of a class -> pairs with rare structure in common.

A function's syntax tree without names, numbers and comments is cut into overlapping pieces
(k-grams), of which winnowing keeps a few (Schleimer, Wilkerson and Aiken, "Winnowing: local
algorithms for document fingerprinting", SIGMOD 2003). Pieces are weighted by their rarity in the
class. Short correct functions are similar by nature, so similarity is not a proof of copying.
"""

import ast
import hashlib
import math
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass
from functools import cache
from itertools import combinations
from pathlib import Path

import falconwing_kit
from falconwing_kit.core.checks import InputError
from falconwing_kit.tools.grading.collect import parse_notebook
from falconwing_kit.tools.grading.course.looks import sources
from falconwing_kit.tools.grading.find import notebook_path
from falconwing_kit.tools.grading.lab import Lab
from falconwing_kit.tools.grading.submissions import Submission, find_submissions

PIECE, WINDOW = 12, 4  # tokens of a piece; pieces of a winnowing window
LEAST_PRINTS = 6  # minimum fingerprints of a compared function
LEAST_SHARE = 0.6  # minimum common share of the smaller function's weight
LISTED = 40  # maximum number of listed pairs of people
MAX_COMPARED = 64 << 10  # characters of a compared function with its dependencies
Fingerprints = frozenset[int]


@dataclass(frozen=True)
class SimilarPair:
    """Two similar functions.

    Attributes:
        exercise: its name.
        left: a student of this class.
        right: another one, one of the earlier class ("before: ..."), or a function of the kit
            ("kit: ...").
        share: common share of the smaller function's weight, 0..1.
        weight: common weight [bit]; a piece that one of N in the class has weighs log2(N + 1).
    """

    exercise: str
    left: str
    right: str
    share: float
    weight: float


@dataclass(frozen=True)
class Similarity:
    """All similar functions of two people.

    Attributes:
        pairs: at least one.
    """

    pairs: tuple[SimilarPair, ...]

    @property
    def left(self) -> str:
        """A student of this class."""
        return self.pairs[0].left

    @property
    def right(self) -> str:
        """The other one, as in SimilarPair."""
        return self.pairs[0].right

    @property
    def weight(self) -> float:
        """Total weight of what both have [bit]."""
        return math.fsum(pair.weight for pair in self.pairs)

    @property
    def functions(self) -> str:
        """The similar functions with their shares, as text."""
        return ", ".join(f"{pair.exercise} {100.0 * pair.share:.0f} %" for pair in self.pairs)


def fingerprints(source: str) -> Fingerprints:
    """Winnowed fingerprints of a piece of Python.

    Returns:
        Numbers that depend on the structure only, not on names, numbers, comments or layout. Empty
        for text that is not Python, shorter than a piece, or longer than MAX_COMPARED.
    """
    if len(source) > MAX_COMPARED:
        return frozenset()
    try:
        tree: ast.AST = ast.parse(source)
    except (SyntaxError, ValueError, RecursionError, MemoryError):
        return frozenset()
    tokens = list(_tokens(tree))
    pieces = [_number(tokens[start : start + PIECE]) for start in range(len(tokens) - PIECE + 1)]
    windows = [
        pieces[start : start + WINDOW]
        for start in range(max(len(pieces) - WINDOW + 1, min(1, len(pieces))))
    ]
    return frozenset(min(window) for window in windows)


def _tokens(tree: ast.AST) -> Iterator[str]:
    """Node kinds in reading order, with the names of attributes (np.cross)."""
    waiting: list[ast.AST] = [tree]
    while waiting:
        node = waiting.pop()
        if isinstance(node, ast.FunctionDef | ast.ClassDef | ast.Module):
            inside: list[ast.AST] = [each for each in node.body if not _is_text(each)]
            yield "function"
        else:
            inside = [
                each
                for each in ast.iter_child_nodes(node)
                if not isinstance(each, ast.expr_context)
            ]
            attribute = f".{node.attr}" if isinstance(node, ast.Attribute) else ""
            yield f"{type(node).__name__}{attribute}"
        if isinstance(node, ast.AnnAssign):
            inside = [each for each in (node.target, node.value) if each is not None]
        waiting += reversed(inside)


def _is_text(node: ast.stmt) -> bool:
    return isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant)


def _number(tokens: list[str]) -> int:
    return int.from_bytes(hashlib.blake2b(" ".join(tokens).encode(), digest_size=8).digest(), "big")


def similar_pairs(
    exercise: str,
    now: Mapping[str, Fingerprints],
    before: Mapping[str, Fingerprints],
    kit: Mapping[str, Fingerprints],
) -> list[SimilarPair]:
    """Similar pairs of one exercise.

    Args:
        now: fingerprints of this class, by student.
        before: of an earlier class.
        kit: of public functions, by name.

    Returns:
        Pairs with at least LEAST_SHARE.
    """
    now, before, kit = (
        {n: p for n, p in each.items() if len(p) >= LEAST_PRINTS} for each in (now, before, kit)
    )
    rarity = Counter(each for prints in now.values() for each in prints)
    bits = {each: math.log2((len(now) + 1) / count) for each, count in rarity.items()}
    one = math.log2(len(now) + 1)

    def weigh(prints: Iterable[int]) -> float:
        return math.fsum(bits.get(each, one) for each in prints)

    elsewhere = {f"before: {name}": each for name, each in before.items()}
    elsewhere |= {f"kit: {name}": each for name, each in kit.items()}
    weights = {name: weigh(prints) for name, prints in {**now, **elsewhere}.items()}
    pairs = []
    for left, right in (
        *combinations(now, 2),
        *((left, right) for left in now for right in elsewhere),
    ):
        both = now[left] & (now[right] if right in now else elsewhere[right])
        if both:
            weight = weigh(both)
            share = weight / max(min(weights[left], weights[right]), 1e-9)
            if share >= LEAST_SHARE:
                pairs.append(SimilarPair(exercise, left, right, share, weight))
    return pairs


def kit_functions(folder: Path | None = None) -> dict[str, str]:
    """Source of every function of the kit, by module path and name."""
    root = folder or Path(falconwing_kit.__file__).parent
    found = {}
    for path in sorted(root.rglob("*.py")):
        text = path.read_text(encoding="utf-8")
        lines = text.encode().splitlines(keepends=True)
        for node in ast.walk(ast.parse(text)):
            if isinstance(node, ast.FunctionDef):
                place = ".".join((*path.relative_to(root).with_suffix("").parts, node.name))
                found[place] = _source(lines, node)
    return found


@cache
def _kit() -> tuple[Mapping[str, str], Mapping[str, Fingerprints]]:
    """Sources and fingerprints of the kit's functions, the same for every class and lab."""
    readable = kit_functions()
    return readable, {name: fingerprints(text) for name, text in readable.items()}


def _source(lines: list[bytes], node: ast.FunctionDef) -> str:
    """A function's text, as of `ast.get_source_segment`, which cuts the file into lines each time.

    Args:
        lines: of the file, with their ends; places in them are counted in bytes.
        node: the function.
    """
    inside = lines[node.lineno - 1 : node.end_lineno]
    inside[-1] = inside[-1][: node.end_col_offset]
    inside[0] = inside[0][node.col_offset :]
    return b"".join(inside).decode()


def compare_class(
    folder: Path, lab: Lab, now: Mapping[str, Mapping[str, str]], before: Path | None = None
) -> tuple[list[Similarity], dict[tuple[str, str], str]]:
    """Compare a class's functions with each other, an earlier class, the kit and the solution.

    Args:
        folder: of the lab, with the published solution.
        now: for each student the text of each exercise's function.
        before: submissions of an earlier class; None for none.

    Returns:
        Similarities by decreasing weight, and the texts by exercise and by the pair's names.

    Raises:
        InputError: there are no notebooks at `before`.
    """
    earlier = {name: _texts(each.read, lab) for name, each in _earlier(before, lab).items()}
    readable, known = _kit()
    solution = notebook_path(folder, solution=True)
    solved = _texts(solution.read_bytes, lab) if solution.is_file() else {}
    pairs: list[SimilarPair] = []
    texts: dict[tuple[str, str], str] = {}
    for exercise in (each.name for each in lab.exercises):
        sides = {name: each.get(exercise, "") for name, each in now.items()}
        old = {name: each.get(exercise, "") for name, each in earlier.items()}
        kit = {**known, "solution": fingerprints(solved.get(exercise, ""))}
        prints = [
            {name: fingerprints(text) for name, text in side.items()} for side in (sides, old)
        ]
        pairs += similar_pairs(exercise, prints[0], prints[1], kit)
        named = sides | {f"before: {name}": text for name, text in old.items()}
        named |= {
            f"kit: {name}": text
            for name, text in {**readable, "solution": solved.get(exercise, "")}.items()
        }
        texts |= {(exercise, name): text for name, text in named.items()}
    together: dict[tuple[str, str], list[SimilarPair]] = {}
    for pair in pairs:
        together.setdefault((pair.left, pair.right), []).append(pair)
    found = sorted(
        (Similarity(tuple(each)) for each in together.values()), key=lambda each: -each.weight
    )
    return found[:LISTED], texts


def _earlier(before: Path | None, lab: Lab) -> dict[str, Submission]:
    return {each.student: each for each in find_submissions(before, lab.name)} if before else {}


def _texts(read: Callable[[], bytes], lab: Lab) -> dict[str, str]:
    """The functions of a notebook; none if it cannot be read."""
    try:
        return sources(parse_notebook(read(), "the notebook"), lab)
    except (InputError, OSError, MemoryError):
        return {}
