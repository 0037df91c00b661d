"""The reading path and the glossary name what is there."""

import re
from pathlib import Path

from tests.house.file_index import index
from tests.house.rooms import rooms

ROOT = Path(__file__).resolve().parents[2]
PATH = (ROOT / "falconwing_kit" / "README.md").read_text(encoding="utf-8")
GLOSSARY = (ROOT / "manual" / "glossary.md").read_text(encoding="utf-8")


def test_twelve_files_are_there_with_a_question_each():
    """Rows of the table: a number, a link to a file of the book, a question."""
    rows = re.findall(r"^\| (\d+) \| \[([\w/.]+)\]\(([\w/.]+)\) \| (.+) \|$", PATH, re.MULTILINE)
    assert [int(number) for number, *_ in rows] == list(range(1, 13))
    assert all(shown == target and question.endswith("?") for _, shown, target, question in rows)
    assert [
        target for _, _, target, _ in rows if not (ROOT / "falconwing_kit" / target).is_file()
    ] == []


def test_every_room_stands_in_the_table():
    """The folders of the package against the table of rooms."""
    listed = re.findall(r"^\| [\d-] \| `(\w+)` \|", PATH, re.MULTILINE)
    assert sorted(listed) == sorted(room for room in rooms(ROOT) if room != "(top)")


def test_the_index_of_files_is_up_to_date():
    """Made from the docstrings by `python tests/house/file_index.py --write`."""
    assert PATH.endswith(index())


def test_links_lead_somewhere():
    """Every link of both pages, from where it stands."""
    for text, folder in ((PATH, ROOT / "falconwing_kit"), (GLOSSARY, ROOT / "manual")):
        targets = [target for target in re.findall(r"\]\(([^)]+)\)", text) if "://" not in target]
        assert [target for target in targets if not (folder / target).exists()] == []


def test_names_of_the_glossary_are_in_the_book():
    """Each name in the second column, as a whole word of the book's source."""
    book = "\n".join(
        path.read_text(encoding="utf-8")
        for room, paths in rooms(ROOT).items()
        if room != "tools"
        for path in paths
    )
    words = set(re.findall(r"\w+", book))
    rows = [
        line.split(" | ")
        for line in GLOSSARY.splitlines()
        if line.startswith("| ") and "---" not in line
    ]
    named = [name for row in rows for name in re.findall(r"`(\w+)`", row[1])]
    assert len(rows) > 60 and len(named) > 60
    assert [name for name in named if name not in words] == []
