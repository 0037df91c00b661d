"""Names carry frames: in a product the inner frames must meet, and the result is called what the
product gives.

`T_world_body @ T_body_camera` meets at body and is `T_world_camera`; `R_world_body @ v_world` does
not meet. What cannot be read from the names is passed over.
"""

import ast
import re
from functools import cache
from pathlib import Path
from typing import NamedTuple

ROOT = Path(__file__).resolve().parents[2]
FRAMES = {"world", "body", "camera", "marker", "wind", "scene", "ned", "enu", "leader", "pad"}
MAP = re.compile(r"_?(?:R|T)s?_([a-z0-9]+)_([a-z0-9]+)(?:_.*)?", re.IGNORECASE)
VECTOR = re.compile(r"_?(?:p|v)s?_([a-z0-9]+)(?:_.*)?", re.IGNORECASE)


class Frames(NamedTuple):
    """What a name or a product says: a map takes `inner` vectors to `outer` ones, a vector has one
    frame.
    """

    outer: str | None
    inner: str | None
    is_vector: bool


UNREAD = Frames(None, None, False)


def test_frames_meet_in_every_product():
    """The rule of STYLE.md, section 2."""
    assert frame_problems(ROOT) == []


def frame_problems(tree: Path) -> list[str]:
    """Products and assignments whose names contradict each other, one line each with file and line.

    Args:
        tree: folder that holds falconwing_kit.
    """
    problems = []
    for path in sorted((tree / "falconwing_kit").rglob("*.py")):
        where = path.relative_to(tree).as_posix()
        found = contradictions(path.read_text(encoding="utf-8"))
        problems += [f"{where}:{line}: {text}" for line, text in found]
    return problems


@cache  # a planted fault changes one file of hundreds
def contradictions(source: str) -> list[tuple[int, str]]:
    """Line and reason of every product and assignment whose names contradict each other."""
    found = []
    for node in ast.walk(ast.parse(source)):
        text = ""
        if isinstance(node, ast.BinOp) and isinstance(node.op, ast.MatMult):
            text = unmet(read(node.left), read(node.right))
        elif isinstance(node, ast.Assign) and len(node.targets) == 1:
            text = misnamed(read(node.targets[0]), node.value)
        if text:
            found.append((node.lineno, f"{text} in {ast.unparse(node)[:90]}"))
    return found


def unmet(left: Frames, right: Frames) -> str:
    """Why a product's inner frames do not meet; empty if they do or are not known."""
    if left.inner and right.outer and left.inner != right.outer:
        return f"{left.inner} meets {right.outer}"
    return ""


def misnamed(target: Frames, value: ast.expr) -> str:
    """Why the name of a result contradicts the product that it is given; empty if it does not."""
    if not (isinstance(value, ast.BinOp) and isinstance(value.op, ast.MatMult)):
        return ""
    result = read(value)
    wrong_outer = target.outer and result.outer and target.outer != result.outer
    wrong_inner = target.inner and result.inner and target.inner != result.inner
    if not (wrong_outer or wrong_inner):
        return ""
    product = f"a product of {result.outer} and {result.inner}"
    return f"{product} is called {target.outer} and {target.inner}"


def read(node: ast.expr) -> Frames:
    """The frames of an expression, from the names in it."""
    if isinstance(node, ast.Subscript):
        return read(node.value)
    if isinstance(node, ast.Attribute) and node.attr in ("T", "mT"):
        return turned(read(node.value))
    if isinstance(node, ast.Call) and ast.unparse(node.func).endswith("linalg.inv") and node.args:
        return turned(read(node.args[0]))
    if isinstance(node, ast.BinOp) and isinstance(node.op, ast.MatMult):
        return product(read(node.left), read(node.right))
    if isinstance(node, ast.Name | ast.Attribute):
        return read_name(node.id if isinstance(node, ast.Name) else node.attr)
    return UNREAD


def read_name(name: str) -> Frames:
    """The frames that a name carries."""
    two = MAP.fullmatch(name)
    if two and {two[1].lower(), two[2].lower()} <= FRAMES:
        return Frames(two[1].lower(), two[2].lower(), False)
    one = VECTOR.fullmatch(name)
    if one and one[1].lower() in FRAMES:
        return Frames(one[1].lower(), one[1].lower(), True)
    return UNREAD


def turned(frames: Frames) -> Frames:
    """The frames of a transpose or an inverse."""
    return Frames(frames.inner, frames.outer, frames.is_vector)


def product(left: Frames, right: Frames) -> Frames:
    """The frames of a product; rows of vectors may stand on the left, as in `v_body @
    R_world_body.T`.
    """
    if left.is_vector:
        return Frames(right.inner, right.inner, True)
    if right.is_vector:
        return Frames(left.outer, left.outer, True)
    return Frames(left.outer, right.inner, False)
