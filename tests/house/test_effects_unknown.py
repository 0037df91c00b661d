"""No file outside `aircraft/effects` knows an effect of the catalogue or one of its parameters."""

import ast
import re
from functools import cache
from pathlib import Path

from falconwing_kit.aircraft.effects import CATALOGUE

ROOT = Path(__file__).resolve().parents[2]
NAMES = {e.name for e in CATALOGUE} | {p.name for e in CATALOGUE for p in e.parameters}
QUOTED = re.compile(rf"""["']({"|".join(sorted(NAMES))})["']""")
UNIFORM_WIND = {"wind_x", "wind_y"}
# Reviewed: the file, and which of these words mean something else in it or are its subject.
ALLOWED: dict[str, set[str]] = {
    "aircraft/terms.py": UNIFORM_WIND,  # the base model's uniform wind
    "aircraft/model.py": UNIFORM_WIND,
    "trainer_port/protocol.py": {"stall"},  # a fault of the board's protocol
    "trainer_port/safety.py": {"stall"},
    "tools/cli/firmware.py": {"stall"},
    # The demo's recorded flights: a column, the model's uniform wind, and the effects they show.
    "tools/demo/alfa.py": {"wind", "thrust_loss", *UNIFORM_WIND},
    "tools/demo/recorded.py": {"thrust_loss", "thrust_lost", "wind", *UNIFORM_WIND},
}


def test_no_file_knows_an_effect_by_name():
    """DESIGN.md, section 2: an effect is one file; nothing else knows its name."""
    assert effect_problems(ROOT) == []


def test_the_reviewed_list_is_as_short_as_it_can_be():
    """Each entry is needed: without it the file would be reported."""
    found = {path: known for path, known in uses(ROOT) if path in ALLOWED}
    assert {path: {name for _, name in known} for path, known in found.items()} == ALLOWED


def effect_problems(tree: Path) -> list[str]:
    """String literals, attributes and keywords that are an effect's or its parameter's name; the
    same in quotes in a page's template.

    Args:
        tree: folder that holds falconwing_kit.
    """
    return [
        f"falconwing_kit/{path}:{line}: {name!r} belongs to aircraft/effects"
        for path, known in uses(tree)
        for line, name in known
        if name not in ALLOWED.get(path, set())
    ]


def uses(tree: Path) -> list[tuple[str, list[tuple[int, str]]]]:
    """Of every file outside aircraft/effects: the lines and names."""
    package, found = tree / "falconwing_kit", []
    for path in sorted(package.rglob("*.py")):
        where = path.relative_to(package).as_posix()
        if where.startswith("aircraft/effects/"):
            continue
        found.append((where, names_in(path.read_text(encoding="utf-8"))))
    for path in sorted(package.rglob("*.j2")):
        lines = enumerate(path.read_text(encoding="utf-8").splitlines(), start=1)
        known = [(line, name) for line, text in lines for name in QUOTED.findall(text)]
        found.append((path.relative_to(package).as_posix(), known))
    return found


@cache  # a planted fault changes one file of hundreds
def names_in(source: str) -> list[tuple[int, str]]:
    """Line and name of every string, attribute and keyword that is one of NAMES."""
    known = []
    for node in ast.walk(ast.parse(source)):
        name = getattr(node, "attr", getattr(node, "arg", None))
        if isinstance(node, ast.Constant) and isinstance(node.value, str):
            known.append((node.lineno, node.value))
        elif isinstance(node, ast.Attribute | ast.keyword) and name:
            known.append((getattr(node, "lineno", 0), name))
    return [(line, name) for line, name in known if name in NAMES]


def test_a_template_that_names_an_effect_is_reported(tmp_path):
    """Written here by hand."""
    folder = tmp_path / "falconwing_kit" / "tools"
    folder.mkdir(parents=True)
    (folder / "page.html.j2").write_text('<p>\n{% if "fan_jet" in record.effects %}\n')
    assert effect_problems(tmp_path) == [
        "falconwing_kit/tools/page.html.j2:2: 'fan_jet' belongs to aircraft/effects"
    ]
