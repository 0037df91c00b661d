"""A checkout -> lines, files, comments and closures of every room of falconwing_kit, as a table.

    python tests/house/rooms.py [ROOT] [FILE ...]

A closure is what a reader may have to open: a file with everything of the kit that it imports,
directly or not. For a room it is that of all its files. With FILES, such as
`trainer_port/protocol.py`, the closure of each is added. No test holds any of these numbers to a
limit.
"""

import ast
import io
import sys
import tokenize
from collections.abc import Iterable, Iterator
from pathlib import Path

PACKAGE = "falconwing_kit"


def closure(root: Path, files: Iterable[Path]) -> set[Path]:
    """The files and all files of the kit that they import, directly or not; faces that are passed
    through count.
    """
    found, waiting = set(), list(files)
    while waiting:
        path = waiting.pop()
        if path not in found:
            found.add(path)
            waiting += [each for name in imported(path) for each in files_of(root, name)]
    return found


def imported(path: Path) -> Iterator[str]:
    """Dotted names of the kit that a file imports, those inside functions too."""
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names if alias.name.startswith(PACKAGE))
        elif isinstance(node, ast.ImportFrom) and (node.module or "").startswith(PACKAGE):
            yield from (f"{node.module}.{alias.name}" for alias in node.names)


def files_of(root: Path, name: str) -> list[Path]:
    """The file of a dotted name: a module, a package's `__init__`, or where the name is defined."""
    path = root / name.replace(".", "/")
    places = (
        path.with_suffix(".py"),
        path / "__init__.py",
        path.parent.with_suffix(".py"),
        path.parent / "__init__.py",
    )
    for file in places:
        if file.is_file():
            return [file]
    return []


def lines(paths: Iterable[Path]) -> int:
    """Lines of some files together."""
    return sum(len(path.read_text(encoding="utf-8").splitlines()) for path in paths)


def comments_per_100(paths: Iterable[Path]) -> float:
    """Comments per hundred lines of function bodies without their docstrings, those beside code
    included.
    """
    body = comments = 0
    for path in paths:
        source = path.read_text(encoding="utf-8")
        inside: set[int] = set()
        for node in ast.walk(ast.parse(source)):
            if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
                first = node.body[1 if ast.get_docstring(node) is not None else 0 :]
                inside |= set(range(first[0].lineno, node.end_lineno + 1)) if first else set()
        body += len(inside)
        tokens = tokenize.generate_tokens(io.StringIO(source).readline)
        # A comment before the first statement of a body belongs to it too.
        comments += sum(
            token.type == tokenize.COMMENT and bool({token.start[0], token.start[0] + 1} & inside)
            for token in tokens
        )
    return 100.0 * comments / max(body, 1)


def rooms(root: Path) -> dict[str, list[Path]]:
    """Rooms of the book, then the toolbox as one, each with its files."""
    found: dict[str, list[Path]] = {}
    for path in sorted((root / PACKAGE).rglob("*.py")):
        parts = path.relative_to(root / PACKAGE).parts
        found.setdefault(parts[0] if len(parts) > 1 else "(top)", []).append(path)
    return dict(sorted(found.items(), key=lambda item: (item[0] == "tools", item[0])))


def main(words: list[str]) -> int:
    """Print the table."""
    root = Path(words[0] if words else ".").resolve()
    print(
        f"{'room':<16}{'files':>6}{'lines':>8}{'comments/100':>14}"
        f"{'closure: files':>16}{'lines':>8}"
    )
    book: list[Path] = []
    for room, paths in rooms(root).items():
        if room != "tools":
            book += paths
        if room == "tools":
            print(f"{'the book':<16}{len(book):>6}{lines(book):>8}{comments_per_100(book):>14.1f}")
        reach = closure(root, paths)
        print(
            f"{room:<16}{len(paths):>6}{lines(paths):>8}{comments_per_100(paths):>14.1f}{len(reach):>16}{lines(reach):>8}"
        )
    for name in words[1:]:
        reach = closure(root, [root / PACKAGE / name])
        print(f"{name:<46}{len(reach):>14}{lines(reach):>8}")
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
