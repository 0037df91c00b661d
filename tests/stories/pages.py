"""The pages that a reader has, README and the site's own, and the commands that they ask to be
typed: which these are, a folder to type them in, and how one is run.
"""

import importlib.util
import re
import shlex
import shutil
from collections.abc import Iterable
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest

from falconwing_kit.core.flight_log import FlightLogWriter
from falconwing_kit.core.messages import Command, State
from falconwing_kit.data import data_path
from falconwing_kit.tools.cli.main import main
from falconwing_kit.tools.grading.find import load_checks
from falconwing_kit.tools.grading.records import append_record, open_run
from falconwing_kit.trainer_port.usb import find_boards
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
# Verbs that keep to the wall's clock, start programs that do, or share their work among processes
# with one cache of numba; `fly` keeps to the clock with a port.
ALONE = {
    "bench", "bridge", "calibrate", "class", "doctor", "find-port", "firmware", "record",
    "reproduce", "sandbox",
}  # fmt: skip


def needs_the_machine(line: str) -> bool:
    """Whether a command of the kit needs the machine to itself."""
    words = shlex.split(line)[1:]
    with_port = words[0] == "fly" and {"--port", "--bench"} & set(words)
    return words[0] in ALONE or bool(with_port)


def marked(lines: Iterable[str]) -> list[Any]:
    """Commands as parameters of a test, those that need the machine to themselves with that mark;
    `reproduce`, which may take minutes, has more time.
    """
    parameters = []
    for line in lines:
        marks = [pytest.mark.alone] if needs_the_machine(line) else []
        marks += [pytest.mark.timeout(900)] if shlex.split(line)[1] == "reproduce" else []
        parameters.append(pytest.param(line, marks=marks))
    return parameters


def figures_of_the_manual() -> ModuleType:
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


def make_folder(tmp_path):
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


def run_as_typed(line, folder, capsys):
    """Run a command as printed, in a folder with a flight and a log, with no terminal to answer; 0
    means done, 1 that no board is there or that the watched flight raised an alarm; --out is there.
    """
    words = shlex.split(line)[1:]
    if words[0] == "firmware" or re.search(r"--port sim(?![\w-])", line):  # sim-python needs none
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
    assert capsys.readouterr().out.count("\n") > (1 if words[0] == "find-port" else 3)
