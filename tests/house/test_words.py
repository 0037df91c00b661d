"""Plain scientific English: a list of private words, found nowhere in book, messages and pages."""

import re
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
# What data, models and functions cannot do, and fillers; on the right what the field says.
WORDS = {
    r"wants?\b": "expects, requires",
    r"mend(?:s|ed|ing)?\b": "repairs, corrects",
    r"told\b": "given, reported",
    r"tells?\b": "reports, shows",
    r"knows\b": "models, has",
    r"minds\b": "depends on",
    r"strays?\b": "jitter, outlier",
    r"surpris\w+": "anomaly, process noise",
    r"likeness\b": "similarity, correlation",
    r"doubts?\b": "cost, uncertainty",
    r"sights?\b": "detections, observations",
    r"nobody\b": "no one, none",
    r"whoever\b": "any",
    r"for ever\b": "indefinitely",
    r"to and fro\b": "back and forth",
    r"foretells?\b": "predicts",
}
PATTERN = re.compile(r"\b(?:" + "|".join(WORDS) + ")", re.IGNORECASE)
PAGES = (
    "README.md",
    "CONTRIBUTING.md",
    "falconwing_kit/README.md",
    "manual/*.md",
    "manual/site/**/*.md",
    "manual/chapters/*.typ",
    "manual/builder/*.toml",
    "manual/*.toml",
    "hardware/*.md",
    "hardware/*.toml",
    "firmware/*.md",
    "labs/*.md",
)


def test_private_words_stay_out():
    """Every line of the book's files and of the pages that a newcomer reads."""
    assert word_problems(ROOT) == []


@pytest.mark.parametrize(
    "line", ["# the pilot is told", '"mass: want a number"', "A model foretells it."]
)
def test_a_planted_word_is_reported(tmp_path, line):
    """Written here by hand, in a file of the book."""
    room = tmp_path / "falconwing_kit" / "core"
    room.mkdir(parents=True)
    (room / "planted.py").write_text(f'"""A file."""\n{line}\n')
    assert [problem.split(": ")[0] for problem in word_problems(tmp_path)] == [
        "falconwing_kit/core/planted.py:2"
    ]


def test_a_planted_word_on_a_page_of_the_site_is_reported(tmp_path):
    """A folder below the site's own."""
    (tmp_path / "manual" / "site" / "concepts").mkdir(parents=True)
    (tmp_path / "manual" / "site" / "concepts" / "loop.md").write_text("# Loop\n\nIt knows.\n")
    assert word_problems(tmp_path) == ["manual/site/concepts/loop.md:3: knows"]


@pytest.mark.parametrize(
    "name",
    [
        *("manual/builder/radio.toml", "manual/assembly.toml", "hardware/checklists.toml"),
        *("hardware/README.md", "firmware/README.md"),
    ],
)
def test_a_planted_word_in_the_builders_pages_is_reported(tmp_path, name):
    """A line of a table, of a step, of a checklist or of a guide, written here."""
    (tmp_path / name).parent.mkdir(parents=True)
    (tmp_path / name).write_text('why = "the radio wants it"\n')
    assert word_problems(tmp_path) == [f"{name}:1: wants"]


def word_problems(root: Path) -> list[str]:
    """Lines with a word of the list, one problem each with file, line and word.

    Args:
        root: a checkout, or a folder that holds falconwing_kit.
    """
    book = (
        path
        for path in (root / "falconwing_kit").rglob("*.py")
        if "tools" not in path.relative_to(root).parts
    )
    pages = (path for pattern in PAGES for path in root.glob(pattern))
    return [
        f"{path.relative_to(root).as_posix()}:{number}: {found[0]}"
        for path in sorted({*book, *pages})
        for number, line in enumerate(path.read_text(encoding="utf-8").splitlines(), 1)
        for found in [PATTERN.search(line)]
        if found
    ]
