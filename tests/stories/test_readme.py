"""README and the site's own pages are true: their commands run, their figures are what the demo
says, their tables name what is there.
"""

import importlib.util
import re
import shlex
import shutil
from pathlib import Path

import numpy as np
import pytest

from falconwing_kit import __version__
from falconwing_kit.core.flight_log import FlightLogWriter
from falconwing_kit.core.flight_table import LABEL_COLUMN, OPTIONAL_COLUMNS, REQUIRED_COLUMNS
from falconwing_kit.core.messages import Command, State
from falconwing_kit.data import data_path
from falconwing_kit.tools.cli.main import VERBS, main
from falconwing_kit.tools.grading.find import load_checks
from falconwing_kit.tools.grading.records import append_record, open_run
from falconwing_kit.trainer_port.usb import find_boards
from tests.demo_run import WORDS, demo_run
from tests.firmware.chip import require_tools
from tests.labs.tools import require_sandbox
from tests.model_files import write_windy_model
from tests.tools.bridge.ros2_logs import turns, write_flight

ROOT = Path(__file__).resolve().parents[2]
SITE = ROOT / "manual" / "site"
README = (ROOT / "README.md").read_text(encoding="utf-8")
PAGES = {
    path.relative_to(ROOT).as_posix(): path.read_text(encoding="utf-8")
    for path in (ROOT / "README.md", *sorted(SITE.rglob("*.md")))
}
INLINE = re.compile(r"`((?:falconwing|python3 start\.py|\.venv/bin/\S+) [^`]+)`")
TABLE = "manual/site/commands.md"  # where each verb has its line, if README has none
# What a person types around the kit's own commands: nothing here is the kit's to test.
AROUND = {
    "source .venv/bin/activate",
    "python3 -m venv .venv",
    ".venv/bin/pip install --extra-index-url https://download.pytorch.org/whl/cpu"
    ' -c constraints.txt -e ".[labs,dev]"',
    "conda env create -f environment.yml",
    "conda activate falconwing",
}


def page(name: str) -> str:
    """A page of the site by its path there."""
    return PAGES[f"manual/site/{name}"]


def fenced(language: str, text: str) -> list[str]:
    """The contents of a page's fenced blocks of a language, indented ones too."""
    return re.findall(rf"^ *```{language}\n(.*?)^ *```", text, re.MULTILINE | re.DOTALL)


def commands(*texts: str) -> list[str]:
    """Every command that pages ask to be typed, in order, each once."""
    lines = [
        line.strip()
        for text in texts or PAGES.values()
        for block in fenced("sh", text)
        for line in block.splitlines()
        if line.strip()
    ]
    inline = [found for text in texts or PAGES.values() for found in INLINE.findall(text)]
    return list(dict.fromkeys(lines + inline))


OURS = [line for line in commands() if shlex.split(line)[0] == "falconwing"]
STARTS = [line for line in commands() if line.startswith("python3 start.py")]


def figures_of_the_manual():
    """The script that draws them, as a module."""
    spec = importlib.util.spec_from_file_location(
        "make_figures", ROOT / "manual" / "figures" / "make_figures.py"
    )
    make = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(make)
    return make


def grade_by_hand(out):
    """What a run of the grader leaves, for one student of lab 1 who could do half of everything."""
    lab = load_checks(ROOT / "labs" / "lab01_sizing")
    half = {"right": 1, "cases": 2, "categories": {"wrong value": 1}, "problems": []}
    exercises = {
        each.name: half | {"points": each.points / 2.0, "of": each.points} for each in lab.exercises
    }
    told = {
        "student": "ada",
        "sha256": "",
        "status": "graded",
        "problem": "",
        "points": 37.5,
        "of": 75.0,
    }
    open_run(out, "lab01", "", sandboxed=True, go_on=False)
    append_record(out, told | {"sandboxed": True, "exercises": exercises})


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """A folder as the reader has it: the kit's data, an own flight, an own log of two seconds, one
    of ROS 2, a model file, the airframe of its page, and lab 1, done.
    """
    shutil.copytree(data_path("case02_calm.csv").parent, tmp_path / "falconwing_kit" / "data")
    shutil.copy(data_path("case02_calm.csv"), tmp_path / "flight.csv")
    for notebook in ("labs/lab01_sizing/solution/lab01.ipynb", "submissions/ann.ipynb"):
        (tmp_path / notebook).parent.mkdir(parents=True, exist_ok=True)
        shutil.copy(
            ROOT / "labs" / "lab01_sizing" / "solution" / "lab01.ipynb", tmp_path / notebook
        )
    with FlightLogWriter(tmp_path / "flight.mcap") as log:
        for k in range(40):
            log.state(0.05 * k, State.from_vector(np.arange(9.0) / 10.0 + k / 100.0))
            log.command(0.05 * k, Command(0.5, 0.0, 0.1, 0.0))
    write_flight(tmp_path / "ros2_log.mcap", turns())
    write_windy_model(tmp_path / "out" / "model_with_effect.toml")
    (airframe,) = fenced("toml", page("howto/aircraft.md"))
    (tmp_path / "my_airframe.toml").write_text(airframe, encoding="utf-8")
    monkeypatch.chdir(tmp_path)
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


@pytest.mark.parametrize("line", [line for line in OURS if " demo " not in line])
def test_command_runs(line, folder, capsys):
    """Typed as printed, in a folder with a flight and a log; 0 means done, 1 that no board is there
    or that the watched flight raised an alarm; --out is there.
    """
    words = shlex.split(line)[1:]
    if words[0] == "firmware":
        require_tools()
    if words[0] in ("grade", "sandbox"):
        require_sandbox()
    if words[0] == "report":
        grade_by_hand(folder / words[2])
    if "--bench" in words[1:-1] and words[0] == "fly":  # which the table measures a line before
        assert (
            main(["bench", "--port", "sim-python", "--camera", "sim", "--out", "bench.toml"]) == 0
        )
    if words[0] == "train" and "--data" in words:  # which the page collects a line before
        size = words[words.index("--size") : words.index("--size") + 2]
        assert main(["collect", "--out", "flights", "--flights", "2", "--nominal", *size]) == 0
    if words[0] == "class":  # which flies until Ctrl-C
        words += ["--flights", "1", "--laps", "0", "--no-browser", "--web-port", "0"]
    noticed = words[0] == "watch" or (words[0] == "find-port" and not find_boards())
    assert main(words) == (1 if noticed else 0)
    for option in ("--out", "--figures"):
        if option in words:
            assert (folder / words[words.index(option) + 1]).exists()
    assert capsys.readouterr().out.count("\n") > 3 or words[0] == "find-port"


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


def test_demo_says_what_the_quick_start_shows():
    """The block of that page against a fresh run, line by line.

    Words must be the same. Numbers may differ by a quarter: another processor rounds differently,
    which the one-step fit on raw differences makes large; a change of the answer is larger than
    that.
    """
    (line,) = [line for line in OURS if " demo " in line]
    run = demo_run()
    assert shlex.split(line)[1:] == list(WORDS) and run.code == 0
    (shown,) = fenced("text", page("quick_start.md"))
    number = re.compile(r"\d+\.?\d*")
    for ours, theirs in zip(run.printed.splitlines(), shown.splitlines(), strict=False):
        assert number.sub("#", ours).split() == number.sub("#", theirs).split()
        values, expected = ([float(x) for x in number.findall(text)] for text in (ours, theirs))
        assert values == pytest.approx(expected, rel=0.25)


def test_picture_is_small_and_can_be_made_again(tmp_path):
    """From what the demo found, to the same size in pixels; 300 kB are a second on a slow
    connection.
    """
    make = figures_of_the_manual()
    make.draw_identify_demo(demo_run().found, tmp_path / "again.png")
    ours = ROOT / "manual" / "figures" / "identify_demo.png"
    assert ours.stat().st_size < 300_000
    size = slice(16, 24)  # width and height in a PNG's header
    assert ours.read_bytes()[size] == (tmp_path / "again.png").read_bytes()[size]


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
