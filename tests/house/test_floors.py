"""The book and the toolbox: imports run downward, the book never imports the toolbox, labs import
faces only.
"""

import ast
from functools import cache
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
FLOORS: tuple[tuple[str, ...], ...] = (
    ("core",),
    ("data", "scene", "aircraft", "trainer_port"),  # data: recorded flights that ship with the kit
    ("vision", "control", "sysid"),
    ("flight",),
    ("learning", "gap"),
    ("tools",),
)
FLOOR_OF = {room: number for number, rooms in enumerate(FLOORS) for room in rooms}


def test_imports_run_downward():
    """The floors are those of DESIGN.md, section 2; the toolbox stands on top, so no book file
    imports it.
    """
    assert import_problems(ROOT) == []


def test_every_folder_is_installed():
    """An install leaves out a folder without `__init__.py`."""
    assert folder_problems(ROOT) == []


def test_labs_import_faces():
    """A face is a room's `__init__`, or that of a folder of the toolbox; what stands behind it may
    move.
    """
    assert lab_problems(ROOT) == []


def import_problems(tree: Path) -> list[str]:
    """Imports that break the floors, one line each with file, line and both floors.

    Args:
        tree: folder that holds falconwing_kit.
    """
    problems = []
    for path in sorted((tree / "falconwing_kit").rglob("*.py")):
        room = room_of(path.relative_to(tree))
        for line, imported in imports(path.read_text(encoding="utf-8")):
            problem = complaint(room, imported)
            if problem:
                problems.append(f"{path.relative_to(tree).as_posix()}:{line}: {problem}")
    return problems


def folder_problems(tree: Path) -> list[str]:
    """Folders of the package that hold Python files and no `__init__.py`."""
    folders = {path.parent for path in (tree / "falconwing_kit").rglob("*.py")}
    bare = sorted(folder for folder in folders if not (folder / "__init__.py").is_file())
    return [f"{folder.relative_to(tree).as_posix()}: no __init__.py" for folder in bare]


def lab_problems(tree: Path) -> list[str]:
    """Imports in labs/*/*.py that reach behind a face, one line each."""
    problems = []
    for path in sorted((tree / "labs").glob("*/*.py")):
        for line, imported in imports(path.read_text(encoding="utf-8")):
            parts = imported.split(".")
            deepest = (
                4 if parts[1:2] == ["tools"] else 3
            )  # falconwing_kit.room.name or falconwing_kit.tools.room.name
            if parts[0] == "falconwing_kit" and len(parts) > deepest:
                place = f"{path.relative_to(tree).as_posix()}:{line}"
                problems.append(f"{place}: {imported}; import it from its room")
    return problems


def room_of(path: Path) -> str:
    """The folder below falconwing_kit; empty for a file that stands in no room."""
    return path.parts[1] if len(path.parts) > 2 else ""


@cache  # a planted fault changes one file of hundreds
def imports(source: str) -> list[tuple[int, str]]:
    """Line and dotted name of every import in a source, those inside functions too; "." and "*"
    stay visible.
    """
    found: list[tuple[int, str]] = []
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Import):
            found += [(node.lineno, alias.name) for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            module = "." * node.level + (node.module or "")
            found += [(node.lineno, f"{module}.{alias.name}") for alias in node.names]
    return found


def complaint(room: str, imported: str) -> str:
    """What is wrong with an import of `imported` in `room`; empty if nothing."""
    if imported.startswith("."):
        return f"relative import of {imported}; write it in full"
    if imported.endswith(".*"):
        return f"star import of {imported}; name what you need"
    package, *below = imported.split(".")
    if package in ("tests", "labs", "start"):
        return f"the kit imports {imported}, which does not ship with it"
    other = below[0] if below else ""
    if package != "falconwing_kit" or other in ("", room, "__version__"):
        return ""
    if room not in FLOOR_OF or other not in FLOOR_OF:
        importer = room or "a file outside the rooms"
        return f"{importer} imports {other}; both must be rooms of the table of floors"
    here, there = FLOOR_OF[room], FLOOR_OF[other]
    if there < here:
        return ""
    way = "sideways" if there == here else "upward"
    return f"{way} import: {room} (floor {here}) imports {other} (floor {there})"
