"""Names that rooms show are unique, and what a face lists is there."""

import ast
import importlib
from collections import defaultdict
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
ROLES = {"EFFECTS", "TERMS", "MANOEUVRES", "main", "run"}  # the same word in the same role
FACES = sorted(
    path.parent.relative_to(ROOT).as_posix().replace("/", ".")
    for pattern in ("falconwing_kit/*/__init__.py", "falconwing_kit/tools/*/__init__.py")
    for path in ROOT.glob(pattern)
)


def test_names_in_faces_are_unique():
    """A reader who meets a name in a lab finds one room that it can come from."""
    assert repeated_names(ROOT) == {}


@pytest.mark.parametrize("face", FACES)
def test_a_face_holds_what_it_lists(face):
    """`__all__` against the module's own attributes."""
    room = importlib.import_module(face)
    assert [name for name in getattr(room, "__all__", ()) if not hasattr(room, name)] == []


def test_a_repeated_name_is_reported(tmp_path):
    """By hand: two rooms show `Step`; `run` is a role."""
    for room, names in (("core", ["Step", "run"]), ("tools/demo", ["Step", "run", "page"])):
        folder = tmp_path / "falconwing_kit" / room
        folder.mkdir(parents=True)
        (folder / "__init__.py").write_text(f"__all__ = {names!r}\n")
    assert repeated_names(tmp_path) == {"Step": ["core", "tools.demo"]}


def repeated_names(root: Path) -> dict[str, list[str]]:
    """Names that stand in the `__all__` of two rooms or more, with the rooms.

    Args:
        root: folder that holds falconwing_kit.
    """
    where = defaultdict(list)
    for pattern in ("*/__init__.py", "tools/*/__init__.py"):
        for path in sorted((root / "falconwing_kit").glob(pattern)):
            room = path.parent.relative_to(root / "falconwing_kit").as_posix().replace("/", ".")
            for name in listed_names(path):
                where[name].append(room)
    return {name: rooms for name, rooms in where.items() if len(rooms) > 1 and name not in ROLES}


def listed_names(path: Path) -> list[str]:
    """The strings of a file's `__all__`."""
    for node in ast.parse(path.read_text(encoding="utf-8")).body:
        if isinstance(node, ast.Assign) and getattr(node.targets[0], "id", "") == "__all__":
            return list(ast.literal_eval(node.value))
    return []
