"""Every command in the manual is typed here, or in tests/stories where the site has it too and no
file of another command is read, or named as needing hardware with its rehearsal beside it.
"""

import io
import re
import shlex
import shutil
from pathlib import Path

import numpy as np
import pytest

from falconwing_kit.core.flight_log import FlightLogWriter
from falconwing_kit.core.messages import Command, State
from falconwing_kit.data import data_path
from falconwing_kit.tools.cli.main import VERBS, main
from tests.firmware.chip import require_tools
from tests.manual.book import MANUAL, ROOT, commands, elements, page
from tests.model_files import write_windy_model
from tests.stories.pages import OURS, marked

RUNS = list(dict.fromkeys(line for kind, line in commands() if kind == "runs"))
LONG = (
    "identify",
    "gap",
)  # these leave nothing for the commands after them, and test_page_commands types them too
# What the site has too, to the letter, is typed by tests/stories; here are also these, which write
# and read one calibration of a radio.
CALIBRATED = (
    "falconwing calibrate --port sim --out trainer_port.toml",
    "falconwing record --port sim --source sim --seconds 2 --out recordings",
    "falconwing fly --task landing --port sim --headless --no-render --out port",
)
TYPED_HERE = [
    line
    for line in RUNS
    if line in CALIBRATED or (line.split()[1] not in LONG and line not in OURS)
]
# What sets up the reader's machine or needs half a gigabyte: start.py has
# tests/house/test_start.py, bracket and jig tests/hardware/test_bracket.py and test_jig.py.
MACHINE = {
    "python3 start.py demo",
    '.venv/bin/pip install -c constraints.txt -e ".[cad]"',
    ".venv/bin/python hardware/bracket/bracket.py mine.toml --out out",
    ".venv/bin/python hardware/jig/jig.py --parts mine.csv --wing-thickness 12 --out out",
}


ASSEMBLY = ("falconwing size --parts mine.csv", "falconwing print pad --paper A3 --out prints")
NO_COMMANDS = {
    "source .venv/bin/activate",
    "python3 start.py",
    "py start.py demo",
}  # in words, or to be completed


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A folder as the reader has it: the kit's data, a log of two seconds, a model
    file, and lab 1, done.
    """
    here = tmp_path_factory.mktemp("reader")
    shutil.copytree(data_path("case02_calm.csv").parent, here / "falconwing_kit" / "data")
    shutil.copy(ROOT / "labs" / "lab01_sizing" / "solution" / "lab01.ipynb", here)
    write_windy_model(here / "gap" / "model_with_effect.toml")
    with FlightLogWriter(here / "flight.mcap") as log:
        for k in range(40):
            log.state(0.05 * k, State.from_vector(np.arange(9.0) / 10.0 + k / 100.0))
            log.command(0.05 * k, Command(0.5, 0.0, 0.1, 0.0))
    return here


def test_no_command_escapes():
    """Whatever looks like a command, in a block or in a line, was given as one, or is the map's or
    a mere verb.
    """
    known = {line for _, line in commands()}
    known |= set(re.findall(r"`([^`]+)`", (MANUAL / "03_paper_map.md").read_text("utf-8")))
    known |= {f"falconwing {name}" for name, *_ in VERBS} | {"falconwing"}
    # in assembly.toml; the first is in RUNS because chapter 3 prints it too
    known |= {"falconwing size --parts kit", *ASSEMBLY}
    shown = {found["text"] for found in elements("raw")}
    typed = re.compile(r"falconwing(?: |$)|python3? |\.venv/|pip |py |source ")
    assert {text for text in shown if typed.match(text)} - known <= NO_COMMANDS
    assert "falconwing size --parts kit" in RUNS and len(RUNS) >= 15
    assert {line for kind, line in commands() if kind == "machine"} == MACHINE
    assert RUNS.index(CALIBRATED[0]) < min(map(RUNS.index, CALIBRATED[1:]))
    assert len(TYPED_HERE) >= 12


@pytest.mark.parametrize("line", ASSEMBLY)
def test_commands_of_the_assembly_run(line, tmp_path, monkeypatch):
    """With the kit's own list under the builder's name."""
    monkeypatch.chdir(tmp_path)
    shutil.copy(ROOT / "hardware" / "parts.csv", "mine.csv")
    assert main(shlex.split(line)[1:]) == 0


@pytest.mark.filterwarnings("ignore:the calibration")
@pytest.mark.parametrize("line", marked(TYPED_HERE))
def test_command_runs(line, folder, monkeypatch, capsys):
    """Typed as printed, with no terminal to answer; 0 means done, and what --out names is there."""
    monkeypatch.chdir(folder)
    monkeypatch.setattr("sys.stdin", io.StringIO())
    words = shlex.split(line)[1:]
    if re.search(r"--port sim(?![\w-])", line):  # sim-python needs none
        require_tools()
    assert main(words) == 0
    for option in ("--out", "--figures"):
        if option in words:
            assert Path(words[words.index(option) + 1]).exists()
    assert capsys.readouterr().out.count("\n") > 1


def test_long_commands_are_those_of_the_table():
    """But for the place that they write to; tests/stories/test_page_commands.py types them."""
    place = re.compile(r"(?<=--out )[\w.]+")
    left = [place.sub("", line) for line in RUNS if line.split()[1] in LONG]
    table = place.sub("", (MANUAL / "site" / "commands.md").read_text("utf-8"))
    assert len(left) == 2 and all(line in table for line in left)


def test_commands_of_the_photos_are_those_of_their_page():
    """That page's own test types them in their order, on the path-traced photos that ship."""
    chapter = (MANUAL / "photos_to_simulator.md").read_text("utf-8")
    told = [line for kind, line in commands() if kind == "chapter"]
    assert len(told) >= 6 and [line for line in told if line not in chapter.splitlines()] == []


def test_hardware_has_a_rehearsal_beside_it():
    """Behind every command with a real port stands one of the same verb with a simulated one, and
    it is typed.
    """
    listed = commands()
    needing = [k for k, (kind, _) in enumerate(listed) if kind == "hardware"]
    assert len(needing) >= 7
    for k in needing:
        (_, real), (kind, rehearsal) = listed[k], listed[k + 1]
        assert kind == "runs" and rehearsal.split()[1] == real.split()[1]
        assert "sim" in rehearsal.split() and " P" in real
    assert page().text.count("Dry run without hardware, simulated:") == len(needing)


def understood(line, monkeypatch):
    """Whether the verb takes these words; it is not run."""
    import importlib

    modules = {
        name: (f"falconwing_kit.tools.cli.{module}", class_name)
        for name, module, class_name, _ in VERBS
    }
    module, class_name = modules[line.split()[1]]
    monkeypatch.setattr(
        getattr(importlib.import_module(module), class_name), "run", lambda settings: 0
    )
    try:
        return main(shlex.split(line)[1:]) == 0
    except SystemExit:
        return False


def test_commands_that_need_hardware_or_a_log_are_understood(monkeypatch, capsys):
    """Those of the steps, and those in the tables of the builder's book; a planted one is not."""
    lines = dict.fromkeys(line for kind, line in commands() if kind in ("hardware", "parses"))
    assert len(lines) >= 20 and [x for x in lines if not understood(x, monkeypatch)] == []
    assert not understood("falconwing bridge --port P --no-such-option", monkeypatch)
    assert "no-such-option" in capsys.readouterr().err
