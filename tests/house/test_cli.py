"""The command falconwing: help, exit codes and sentences are the same for every verb."""

import importlib.util
import sys
import types
from dataclasses import dataclass

import pytest

from falconwing_kit.core.checks import InputError
from falconwing_kit.tools.cli import main as command
from falconwing_kit.tools.cli.main import VERBS, main

PRESENT = [
    verb[0] for verb in VERBS if importlib.util.find_spec(f"falconwing_kit.tools.cli.{verb[1]}")
]


@dataclass(frozen=True)
class Probe:
    """A verb that fails as told."""

    how: str = "ok"
    """What goes wrong."""

    def run(self) -> int:
        """Raise what was asked for, or say that the answer is no."""
        faults = {
            "input": InputError("mass: expected a positive number, got -1"),
            "missing": FileNotFoundError("no flight at nowhere.csv"),
            "disk": OSError(28, "No space left on device", "model.toml"),
            "library": ModuleNotFoundError("No module named 'cv2'", name="cv2"),
            "keys": KeyboardInterrupt(),
        }
        if self.how in faults:
            raise faults[self.how]
        return 1 if self.how == "no" else 0


@pytest.fixture
def probe(monkeypatch):
    """The probe as the verb `probe`."""
    module = types.ModuleType("probe_verb")
    module.Probe = Probe
    monkeypatch.setitem(sys.modules, "falconwing_kit.tools.cli.probe_verb", module)
    monkeypatch.setattr(
        command, "VERBS", (*VERBS, ("probe", "probe_verb", "Probe", "fails as told"))
    )


@pytest.mark.parametrize("verb", PRESENT)
def test_help_of_every_verb_exits_0(verb, capsys):
    """The rule of DESIGN.md, section 6."""
    with pytest.raises(SystemExit) as end:
        main([verb, "--help"])
    assert end.value.code == 0
    assert f"falconwing {verb}" in capsys.readouterr().out


def test_help_lists_every_verb(capsys):
    """One line a verb, from the table in view."""
    assert main(["--help"]) == 0
    lines = capsys.readouterr().out.splitlines()
    for name, _, _, summary in VERBS:
        assert any(line.split()[:1] == [name] and line.endswith(summary) for line in lines)


def test_no_verb_shows_help_and_is_wrong_use(capsys):
    """Nothing was asked, so nothing was done: 2."""
    assert main([]) == 2
    assert "identify" in capsys.readouterr().out


def test_unknown_verb_gets_a_hint(capsys):
    """`docter` is one letter from `doctor`; `xyzzy` is near nothing."""
    assert main(["docter"]) == 2
    assert "perhaps you meant 'doctor'" in capsys.readouterr().err
    assert main(["xyzzy"]) == 2
    assert "perhaps" not in capsys.readouterr().err


def test_unknown_option_is_wrong_use(probe):
    """Exit code 2 as for every wrong use."""
    with pytest.raises(SystemExit) as end:
        main(["probe", "--hwo", "no"])
    assert end.value.code == 2


@pytest.mark.parametrize(
    ("how", "code", "sentence"),
    [
        ("ok", 0, ""),
        ("no", 1, ""),
        ("input", 2, "falconwing: mass: expected a positive number, got -1\n"),
        ("missing", 2, "falconwing: no flight at nowhere.csv\n"),
        ("disk", 2, "falconwing: model.toml: No space left on device\n"),
        (
            "library",
            2,
            "falconwing: the library cv2 is not installed; `falconwing doctor` suggests a fix\n",
        ),
        ("keys", 130, "interrupted\n"),
    ],
)
def test_every_ending_has_its_code_and_one_sentence(probe, capsys, how, code, sentence):
    """0 done, 1 the answer is no, 2 wrong use, 130 as a shell counts Ctrl-C; never a traceback."""
    assert main(["probe", "--how", how]) == code
    assert capsys.readouterr().err == sentence
