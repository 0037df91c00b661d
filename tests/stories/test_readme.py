"""README and the site's own pages are true: those of their commands run that need the machine to
themselves, their pictures can be made again, their tables name what is there.
"""

import importlib.util
import io
import re
import shlex
import shutil
from pathlib import Path

import numpy as np
import pytest

from falconwing_kit import __version__
from falconwing_kit.core.flight_table import LABEL_COLUMN, OPTIONAL_COLUMNS, REQUIRED_COLUMNS
from falconwing_kit.tools.cli.main import VERBS
from tests.stories.pages import (
    AROUND,
    INLINE,
    OURS,
    PAGES,
    README,
    ROOT,
    STARTS,
    TABLE,
    commands,
    fenced,
    figures_of_the_manual,
    make_folder,
    marked,
    needs_the_machine,
    page,
    run_as_typed,
)

# The others are typed by test_page_commands.py and tests/tools/demo/test_recorded.py.
TYPED_HERE = [line for line in OURS if needs_the_machine(line)]


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """A folder as the reader has it, to type commands in."""
    make_folder(tmp_path)
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("sys.stdin", io.StringIO())
    return tmp_path


def test_readme_is_short_and_cites():
    """One screen more than a newcomer reads, and both citations with the paper's number."""
    assert len(README.splitlines()) <= 130
    (block,) = fenced("bibtex", README)
    assert block.count("@") == 2 and "2505.01383" in block
    assert f"version = {{{__version__}}}" in block


def test_no_command_escapes():
    """Each is one of the kit's own or one that we know not to be; the check sees both places where
    commands stand.
    """
    assert set(commands()) - set(OURS) - set(STARTS) == AROUND
    assert len(OURS) > 40 and len(STARTS) == 2
    assert len(commands(README)) > 6
    assert INLINE.findall("type `falconwing size --mass-g 150` or `falconwing_kit`") == [
        "falconwing size --mass-g 150"
    ]


@pytest.mark.parametrize("line", marked(TYPED_HERE))
def test_command_runs(line, folder, capsys):
    """Typed as printed, in a folder with a flight and a log."""
    run_as_typed(line, folder, capsys)


@pytest.mark.parametrize(
    "name, block",
    [(name, block) for name, text in PAGES.items() for block in fenced("python", text)],
)
def test_python_on_a_page_runs(name, block):
    """Copied from the page into an empty program."""
    exec(compile(block, name, "exec"), {})


@pytest.mark.parametrize("line", STARTS)
def test_start_hands_the_verb_over(line, tmp_path, monkeypatch):
    """start.py itself, its commands written down and not run: the last one is the page's verb."""
    spec = importlib.util.spec_from_file_location("start_of_readme", ROOT / "start.py")
    start = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(start)
    (tmp_path / ".venv").mkdir()
    for name in ("pyproject.toml", "constraints.txt"):
        shutil.copy(ROOT / name, tmp_path)
    run = []
    monkeypatch.setattr(start, "ROOT", tmp_path)
    monkeypatch.setattr(start, "answers", lambda command, **_: True)
    monkeypatch.setattr(start, "run", lambda command, *_, **__: run.append(command) or 0)
    verb, *options = shlex.split(line)[2:]
    assert start.main([verb, *options]) == 0
    if verb == "test":
        assert run[-1][1:3] == ["-m", "pytest"] and not options
    else:
        assert run[-1][1:] == [verb, *options] and verb in [name for name, *_ in VERBS]


@pytest.mark.parametrize("name", ["hall", "trained_hall"])
def test_views_of_the_hall_can_be_made_again(name, tmp_path):
    """The same pixels but for a few grey levels: JPEG, and another processor's rounding."""
    import cv2

    make, picture = figures_of_the_manual(), ROOT / "manual" / "figures" / f"{name}.jpg"
    getattr(make, f"draw_{name}")(tmp_path / "again.jpg")
    ours, again = (
        cv2.imread(str(path)).astype(float) for path in (picture, tmp_path / "again.jpg")
    )
    assert picture.stat().st_size < 300_000
    assert np.abs(ours - again).mean() < 1.0


def test_every_verb_stands_in_readme_or_in_the_table():
    """A verb on no page does not exist for a newcomer; README leads to the table."""
    shown = commands(README, PAGES[TABLE])
    assert {shlex.split(line)[1] for line in shown if line.startswith("falconwing ")} >= {
        name for name, *_ in VERBS
    }
    assert f"]({TABLE})" in README


def test_columns_are_those_of_the_reader():
    """The table of columns and the sentence below it, against the file reader's own lists."""
    section = page("howto/your_flight.md")
    rows = [line.split("|")[1] for line in section.splitlines() if line.startswith("| `")]
    assert tuple(re.findall(r"`(\w+)`", " ".join(rows))) == REQUIRED_COLUMNS
    assert f"`{','.join((*OPTIONAL_COLUMNS, LABEL_COLUMN))}`" in section


@pytest.mark.parametrize("name", PAGES)
def test_links_and_paths_lead_somewhere(name):
    """Every file or folder that a page names; links are relative to the page, paths to the kit."""
    path = re.compile(r"`((?:falconwing_kit|firmware|hardware|manual|tests)(?:/[\w./]+)?)`")
    links = [t for t in re.findall(r"\]\(([^)\s]+)\)", PAGES[name]) if not t.startswith("http")]
    here = (ROOT / name).parent
    made = {"../manual.pdf"}  # by the site's build
    assert [t for t in links if t not in made and not (here / t.split("#")[0]).exists()] == []
    assert [t for t in path.findall(PAGES[name]) if not (ROOT / t).exists()] == []
    assert len(links) > 15 or name != "README.md"


def test_no_room_is_left_out():
    """The table of the architecture against the folders."""
    rooms = {path.parent.name for path in (ROOT / "falconwing_kit").glob("*/__init__.py")}
    assert rooms == set(re.findall(r"^\| `falconwing_kit/(\w+)`", page("architecture.md"), re.M))


@pytest.mark.parametrize(
    "name", sorted(name for name in PAGES if "/benchmarks/" in name and "index" not in name)
)
def test_measured_tables_come_with_their_command(name):
    """How to measure it again stands on the page of every table."""
    assert PAGES[name].count("\n| ") >= 4
    assert re.search(r"python -m (?:pytest|tests\.benchmarks)|falconwing fly", PAGES[name])
    assert f"]({Path(name).name})" in page("benchmarks/index.md")


def test_speeds_come_with_their_machine_and_command():
    """A speed without the machine says nothing; how to measure it again must stand beside it."""
    section = page("benchmarks/speed.md")
    assert section.count("\n| ") >= 4
    assert "pytest -m benchmark" in section
    assert re.search(r"core|processor|CPU", section)
