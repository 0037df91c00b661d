"""Everything public is documented: docstrings from line 1 on, types on every public function."""

import ast
import tomllib
from collections.abc import Iterator
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
# Plain arithmetic that NumPy runs and numba compiles carries no types: these files are named in
# pyproject.toml.
UNTYPED_MARK = "# type: ignore[no-untyped-def]"
UNTYPED_FILES = {
    module.replace(".", "/") + ".py"
    for override in tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))["tool"]["mypy"][
        "overrides"
    ]
    if override.get("disallow_untyped_defs") is False
    for module in override["module"]
}
Function = ast.FunctionDef | ast.AsyncFunctionDef


def test_public_things_are_documented():
    """The rule of STYLE.md, sections 1 and 3."""
    assert doc_problems(ROOT) == []


def doc_problems(tree: Path) -> list[str]:
    """Public modules, classes and functions without a docstring or without types, one line each.

    Args:
        tree: folder that holds falconwing_kit.
    """
    problems = []
    for path in sorted((tree / "falconwing_kit").rglob("*.py")):
        where, source = path.relative_to(tree).as_posix(), path.read_text(encoding="utf-8")
        module = ast.parse(source, where)
        if ast.get_docstring(module) is None or module.body[0].lineno != 1:
            problems.append(f"{where}:1: the file does not begin with a docstring")
        for name, node in public_things(module):
            if not ast.get_docstring(node):
                problems.append(f"{where}:{node.lineno}: {name} has no docstring")
            typed = where in UNTYPED_FILES or not isinstance(node, Function) or not untyped(node)
            if not typed and not marked(node, source):
                problems.append(
                    f"{where}:{node.lineno}: {name} has no type for {', '.join(untyped(node))}"
                )
    return problems


def public_things(module: ast.Module) -> Iterator[tuple[str, ast.ClassDef | Function]]:
    """Public classes and functions of a module and public methods of its public classes, with their
    names.
    """
    for node in module.body:
        if isinstance(node, ast.ClassDef | Function) and not node.name.startswith("_"):
            yield node.name, node
            if isinstance(node, ast.ClassDef):
                methods = [inner for inner in node.body if isinstance(inner, Function)]
                yield from (
                    (f"{node.name}.{m.name}", m) for m in methods if not m.name.startswith("_")
                )


def untyped(function: Function) -> list[str]:
    """Names of the arguments without a type, and "return" if what comes out has none."""
    spec = function.args
    arguments = [
        *spec.posonlyargs,
        *spec.args,
        *spec.kwonlyargs,
        *filter(None, (spec.vararg, spec.kwarg)),
    ]
    names = [
        each.arg
        for each in arguments
        if each.annotation is None and each.arg not in ("self", "cls")
    ]
    return names + (["return"] if function.returns is None else [])


def marked(function: Function, source: str) -> bool:
    """Whether the function says that it goes without types."""
    head = source.splitlines()[function.lineno - 1 : function.body[0].lineno - 1]
    return any(UNTYPED_MARK in line for line in head)
