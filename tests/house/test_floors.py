"""The house has floors: imports run downward, rooms on one floor do not know each other, rooms and files stay small."""

import ast
from collections.abc import Iterator
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
FLOORS: tuple[tuple[str, ...], ...] = (
    ("core",),
    ("data", "scene", "aircraft", "trainer_port"),  # data: recorded flights that ship with the kit
    ("vision", "control", "sysid"),
    ("flight",),
    ("learning", "gap"),
    ("demo", "grading"),
    ("cli",),
)
FLOOR_OF = {room: number for number, rooms in enumerate(FLOORS) for room in rooms}
MAX_FILES, MAX_LINES = 10, 450


def test_imports_run_downward():
    """The floors are those of DESIGN.md, section 2."""
    assert import_problems(ROOT) == []


def test_rooms_and_files_stay_small():
    """At most ten files a room; 400 lines are the aim and 450 the end."""
    assert size_problems(ROOT) == []


def import_problems(tree: Path) -> list[str]:
    """Imports that break the floors, one line each with file, line and both floors.

    Args:
        tree: folder that holds falconwing_kit.
    """
    problems = []
    for path in sorted((tree / "falconwing_kit").rglob("*.py")):
        room = room_of(path.relative_to(tree))
        for line, imported in imports(path):
            problem = complaint(room, imported)
            if problem:
                problems.append(f"{path.relative_to(tree).as_posix()}:{line}: {problem}")
    return problems


def room_of(path: Path) -> str:
    """The folder below falconwing_kit; empty for a file that stands in no room."""
    return path.parts[1] if len(path.parts) > 2 else ""


def imports(path: Path) -> Iterator[tuple[int, str]]:
    """Line and dotted name of every import in a file, those inside functions too; "." and "*" stay visible."""
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"), str(path))):
        if isinstance(node, ast.Import):
            yield from ((node.lineno, alias.name) for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            module = "." * node.level + (node.module or "")
            yield from ((node.lineno, f"{module}.{alias.name}") for alias in node.names)


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
        return f"{room or 'a file outside the rooms'} imports {other}; both must be rooms of the table of floors"
    here, there = FLOOR_OF[room], FLOOR_OF[other]
    if there < here:
        return ""
    way = "sideways" if there == here else "upward"
    return f"{way} import: {room} (floor {here}) imports {other} (floor {there})"


def size_problems(tree: Path) -> list[str]:
    """Rooms with too many files or no `__init__.py` (an install leaves them out), and files with too many lines.

    A folder inside a room is a room of its own; it stands on the same floor.
    """
    problems, house = [], tree / "falconwing_kit"
    for room in sorted(path for path in house.rglob("*") if path.is_dir()):
        files = [path for path in room.glob("*.py") if path.name != "__init__.py"]
        name = room.relative_to(house).as_posix()
        if files and not (room / "__init__.py").is_file():
            problems.append(f"{name}: no __init__.py")
        if len(files) > MAX_FILES:
            problems.append(f"{name}: {len(files)} files, at most {MAX_FILES}")
    for path in sorted((tree / "falconwing_kit").rglob("*.py")):
        lines = len(path.read_text(encoding="utf-8").splitlines())
        if lines > MAX_LINES:
            problems.append(f"{path.relative_to(tree).as_posix()}: {lines} lines, at most {MAX_LINES}")
    return problems
