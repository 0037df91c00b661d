"""The map of the paper is true: what it names exists, its commands are understood, its corrections
add up.
"""

import ast
import importlib
import math
import re
import shlex
from itertools import pairwise
from pathlib import Path

import pytest

from falconwing_kit.aircraft.airframe import load_airframe
from falconwing_kit.aircraft.sizing import (
    level_turn_radius,
    level_turn_speed,
    minimum_speed,
    paper_turn_radius,
)
from falconwing_kit.core.messages import COMMAND_NAMES, STATE_NAMES
from falconwing_kit.tools.cli.main import VERBS, main

ROOT = Path(__file__).resolve().parents[2]
MAP = (ROOT / "manual" / "03_paper_map.md").read_text(encoding="utf-8")
QUOTED = re.findall(r"`([^`]+)`", MAP)
COMMANDS = [words for words in QUOTED if words.startswith("falconwing ")]
IN_THE_MODEL_FORMS = {"paper", "rates"}


def defined_names() -> set[str]:
    """Every function, class, method, field and constant of the kit."""
    names = set(STATE_NAMES) | set(COMMAND_NAMES) | IN_THE_MODEL_FORMS
    for path in (ROOT / "falconwing_kit").rglob("*.py"):
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.FunctionDef | ast.ClassDef):
                names.add(node.name)
            elif isinstance(node, ast.Name) and isinstance(node.ctx, ast.Store):
                names.add(node.id)
    return names


def test_every_name_and_file_in_the_map_exists():
    """Names against the source, read with the standard library; files against the tree."""
    known, places = (
        defined_names(),
        [ROOT, ROOT / "falconwing_kit", ROOT / "falconwing_kit" / "data"],
    )
    missing = []
    for words in set(QUOTED) - set(COMMANDS):
        if "/" in words or words.endswith((".csv", ".toml", ".md")):
            missing += [] if any((place / words).exists() for place in places) else [words]
        else:
            missing += [part for part in re.findall(r"[A-Za-z_]\w*", words) if part not in known]
    assert missing == []


@pytest.mark.parametrize("line", sorted(set(COMMANDS)))
def test_command_is_understood(line, monkeypatch):
    """The verb takes these words; what it then does is tested with the verb. Files that it names
    are there.
    """
    words = shlex.split(line)[1:]
    modules = {
        name: (f"falconwing_kit.tools.cli.{module}", class_name)
        for name, module, class_name, _ in VERBS
    }
    module, class_name = modules[words[0]]
    monkeypatch.setattr(
        getattr(importlib.import_module(module), class_name), "run", lambda settings: 0
    )
    if words[1:]:
        assert main(words) == 0
    read = [word for before, word in pairwise(words) if word.endswith(".csv") and before != "--out"]
    assert all((ROOT / word).exists() for word in read)


def test_corrections_add_up():
    """Recomputed from the paper's own table, its masses and its appendix, and each written in the
    map.
    """
    landings_cm = [35, 45, 40, 40, 70, 20, 80, 78]  # Table II, real world, the eight successes
    assert (sum(landings_cm), sum(landings_cm) / 8, round(sum(landings_cm) / 10)) == (408, 51.0, 41)
    assert (
        round(100.0 * 0.025 ** (1.0 / 30.0), 1) == 88.4
    )  # exact two-sided 95 % bound of 30 out of 30: p^30 = 0.025
    assert round(100.0 * math.cos(math.radians(30.0))) == 87
    assert (137 + 9 + 5, 150 + 174) == (151, 324)
    airframe = load_airframe()
    for mass, speed, radius in ((0.150, "7.04 m/s", "8.77 m"), (0.324, "10.35 m/s", "18.9 m")):
        assert f"{float(minimum_speed(mass, airframe)):.2f} m/s" == speed
        assert f"{float(paper_turn_radius(mass, airframe)):.3g} m" == radius
        assert f"{speed}, {radius}" in MAP
    speed = float(level_turn_speed(0.150, airframe))
    held = f"{speed:.2f} m/s and {float(level_turn_radius(0.150, airframe)):.1f} m"
    assert f"needs {held}" in MAP
    for text in ("408 cm, mean 51 cm; 41 cm", "88.4 %", "87 %", "151 g", "324 g"):
        assert text in MAP


def test_symbols_of_state_and_input_are_complete():
    """Every state and every input of the kit has its row, with its sign."""
    table = MAP[MAP.index("## Symbols") : MAP.index("## Equations")]
    rows = [line.split("|") for line in table.splitlines() if line.startswith("| ")]
    named = re.findall(r"`(\w+)`", " ".join(cells[2] for cells in rows))
    for name in (*STATE_NAMES, *COMMAND_NAMES):
        assert name in named
        (row,) = [cells for cells in rows if f"`{name}`" in cells[2]]
        assert row[4].strip(), name
