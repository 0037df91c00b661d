"""A user's file: right ones are read, wrong ones are refused in one sentence with file and line."""

import re
from dataclasses import replace

import numpy as np
import pytest

from falconwing_kit.aircraft import CATALOGUE, Effect, Parameter, load_effects, load_terms
from falconwing_kit.aircraft.user_file import require_effects
from falconwing_kit.core.checks import InputError

HEAD = "import numpy as np\nfrom falconwing_kit.aircraft import Effect, Parameter, Term\n"
SIZE = 'P = (Parameter("gear_size", 0.01, 0.0, 0.3, "1/m", "drag of the gear"),)\n'
GOOD = (
    HEAD
    + SIZE
    + "def gear(air, K):\n    return -K.gear_size * air.airspeed * air.u, 0.0, 0.0, 0.0, 0.0, 0.0\n"
)


def effect(hook: str = "loads=gear", more: str = "", name: str = "gear") -> str:
    """A file with one effect; its EFFECTS stands on line 6."""
    return f'{GOOD}EFFECTS = [Effect("{name}", "The gear is out.", P, {hook}{more})]\n'


# What is wrong, the file, the line that is named and words of the sentence; lines counted by hand.
BAD = {
    "does not parse": (HEAD + "EFFECTS = [\n", 3, "expected Python"),
    "raises": (HEAD + "1 / 0\n", 3, "ZeroDivisionError"),
    "exits": (HEAD + "raise SystemExit(0)\n", 3, "SystemExit"),
    "no list": (GOOD, 1, "expected EFFECTS = "),
    "empty list": (HEAD + "EFFECTS = []\n", 3, "expected a list of Effect"),
    "another type": (HEAD + "EFFECTS = ['gear']\n", 3, "expected Effect objects"),
    "no name": (effect(name=""), 6, "name"),
    "name of the catalogue": (effect(name="flap"), 6, "'flap': expected a new name"),
    "name of a term": (effect(name="lift"), 6, "'lift': expected a new name"),
    "parameter of the catalogue": (
        effect().replace("gear_size", "drag_added"),
        3,
        "'drag_added': expected a new name",
    ),
    "parameter of the model": (effect().replace("gear_size", "cD_0"), 3, "'cD_0': expected a new"),
    "parameter no word": (effect().replace('"gear_size"', '"gear size"'), 3, "like my_size"),
    "bounds the wrong way round": (effect().replace("0.0, 0.3", "0.3, 0.0"), 3, "low <= start"),
    "bounds without zero": (effect().replace("0.0, 0.3", "0.005, 0.3"), 3, "contain 0"),
    "no hook": (effect("acts_on=('along',)"), 6, "exactly one of loads"),
    "two hooks": (effect("loads=gear, wind_field=gear"), 6, "loads and wind_field"),
    "no function": (effect("loads=1.0"), 6, "expected a function"),
    "another parameter's shape": (effect(more=", shape=('else',)"), 6, "'else'"),
    "contains nothing known": (effect(more=", contains=('else',)"), 6, "'else'"),
    "five loads": (effect().replace(", 0.0, 0.0, 0.0\n", ", 0.0, 0.0\n"), 4, "six loads"),
    "no result": (effect().replace("return -K", "-K"), 4, "six loads"),
    "nan": (effect().replace("-K.gear_size", "np.nan * K.gear_size"), 4, "finite"),
    "nan where absent": (
        effect().replace("-K.gear_size", "K.gear_size * K.gear_size / K.gear_size"),
        4,
        "finite",
    ),
    "not absent at zero": (effect().replace("-K.gear_size", "0.1 - K.gear_size"), 4, "zero"),
    "branches on arrays": (
        effect().replace("    return", "    if K.gear_size > 0.0: pass\n    return"),
        5,
        "ValueError",
    ),
    "unknown parameter": (effect().replace("K.gear_size *", "K.gear *"), 5, "AttributeError"),
    "commands lost": (
        effect("command_map=cut").replace(
            "def gear", "def cut(t, u, K):\n    return u[1:]\ndef gear"
        ),
        4,
        "shape (5, 4)",
    ),
    "two times": (effect("input_map=lambda K: (K.gear_size, 0.0)"), 6, "three times"),
    "poses lost": (effect("measurement_map=lambda pose, K: pose[:3]"), 6, "finite poses of shape"),
    "no draw": (effect(more=", sizes=(0.1, 0.2, 0.3)"), 6, "function draw"),
    "another draw": (
        effect(more=", sizes=(0.1, 0.2, 0.3), draw=lambda rng, size: {'else': size}"),
        6,
        "all of its parameters",
    ),
    "equation without its parameter": (
        effect(more=", equation='D/m -> D/m + 0.1 V^2'"),
        6,
        "in braces and nothing else in them ({gear_size})",
    ),
    "equation of another": (effect(more=", equation='{gear_size} {else}'"), 6, "equation"),
    "equation with an open brace": (effect(more=", equation='{gear_size'"), 6, "equation"),
    "equation with a format": (effect(more=", equation='{gear_size:.2f}'"), 6, "equation"),
    "frozen number": (effect(more=", frozen_number=3"), 6, "frozen_number"),
}


@pytest.mark.parametrize("fault", BAD)
def test_a_wrong_file_is_refused_with_file_and_line(fault, tmp_path):
    """One sentence: file, line, what was expected and got."""
    text, line, words = BAD[fault]
    path = tmp_path / "my_effect.py"
    path.write_text(text)
    with pytest.raises(InputError) as refused:
        load_effects(path)
    said = str(refused.value)
    assert said.startswith(f"my_effect.py, line {line}: "), said
    assert words in said and "expected" in said and "\n" not in said


def test_files_that_are_no_text_are_refused(tmp_path):
    """Bytes, a folder, and nothing at all."""
    (tmp_path / "bytes.py").write_bytes(b"\xff\xfe\x00x = 1\x00")
    for path in (tmp_path / "bytes.py", tmp_path):
        with pytest.raises(InputError, match="expected"):
            load_effects(path)
    with pytest.raises(FileNotFoundError):
        load_effects(tmp_path / "none.py")


def test_a_right_file_gives_its_effect(tmp_path):
    """By hand: -0.01 * 7 * 7 m/s^2 along the nose."""
    path = tmp_path / "my_effect.py"
    path.write_text(
        effect(more=", sizes=(0.01, 0.02, 0.03), draw=lambda rng, size: {'gear_size': size}")
    )
    (gear,) = load_effects(path)
    assert (gear.name, [p.name for p in gear.parameters]) == ("gear", ["gear_size"])
    from types import SimpleNamespace as Values

    flow = Values(airspeed=7.0, u=7.0)
    assert gear.loads(flow, Values(gear_size=0.01))[0] == pytest.approx(-0.49)
    with pytest.raises(InputError, match="'gear': expected a new name"):
        require_effects([gear], [*CATALOGUE, gear])


def test_effects_made_in_python_are_checked_alike():
    """Without a file the sentence names the effect."""
    size = (Parameter("gear_size", 0.01, 0.0, 0.3, "1/m", "drag of the gear"),)
    gear = Effect("gear", "The gear is out.", size, loads=lambda air, K: (np.nan,) * 6)
    with pytest.raises(InputError, match=r"^'gear': loads: expected finite"):
        require_effects([gear])
    with pytest.raises(InputError, match="expected Effect objects"):
        require_effects(["gear"])
    with pytest.raises(InputError, match="rename"):
        require_effects([replace(gear, name="flap")])


@pytest.mark.parametrize(
    ("text", "line", "words"),
    [
        (HEAD + "TERM = 1\n", 1, "expected TERMS = "),
        (GOOD + 'TERMS = [Term("lift", P, gear)]\n', 6, "'lift': expected a new name"),
        (GOOD.replace("gear_size", "cL_0") + 'TERMS = [Term("gear", P, gear)]\n', 3, "'cL_0'"),
        (GOOD.replace("0.0, 0.0\n", "\n") + 'TERMS = [Term("gear", P, gear)]\n', 4, "six loads"),
        (GOOD + 'TERMS = [Effect("gear", "The gear.", P, loads=gear)]\n', 6, "Term or WindTerm"),
    ],
)
def test_a_wrong_term_is_refused_with_file_and_line(text, line, words, tmp_path):
    """As effects are."""
    path = tmp_path / "my_term.py"
    path.write_text(text)
    with pytest.raises(InputError, match=rf"^my_term.py, line {line}: .*{re.escape(words)}"):
        load_terms(path)


def test_a_right_term_is_read(tmp_path):
    """Its name and parameter."""
    path = tmp_path / "my_term.py"
    path.write_text(GOOD + 'TERMS = [Term("gear", P, gear)]\n')
    (term,) = load_terms(path)
    assert (term.name, term.parameters[0].name) == ("gear", "gear_size")
