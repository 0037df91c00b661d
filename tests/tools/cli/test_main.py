"""The table of verbs: read from the first lines of files, so that a verb is one file."""

import importlib
import subprocess
import sys

import pytest

from falconwing_kit.tools.cli.main import VERBS, find_verbs, main
from falconwing_kit.tools.cli.size import Size

FIXED = [
    "demo",
    "doctor",
    "size",
    "scene",
    "render",
    "fly",
    "poses",
    "identify",
    "gap",
    "bridge",
    "record",
    "find-port",
    "calibrate",
    "firmware",
    "export",
    "replay",
    "check",
    "labs",
    "grade",
    "report",
    "sandbox",
]


def test_the_fixed_verbs_are_there():
    """The verbs that other people's scripts type; each has a summary of one line."""
    assert set(FIXED) <= {verb.name for verb in VERBS}
    assert all(0 < len(verb.summary) <= 80 and "\n" not in verb.summary for verb in VERBS)


@pytest.mark.parametrize("verb", VERBS, ids=[verb.name for verb in VERBS])
def test_each_verb_has_its_class(verb):
    """A dataclass of the file's name with a `run`."""
    module = importlib.import_module(f"falconwing_kit.tools.cli.{verb.module}")
    assert callable(getattr(module, verb.class_name).run)


def test_a_new_file_is_a_new_verb(tmp_path):
    """Planted: a verb, a step of a verb, a helper and a verb under another name."""
    files = {
        "my_verb.py": '"""falconwing my-verb: do it.\n\nMore text.\n"""\n',
        "scene_cut.py": '"""falconwing scene cut: a step."""\n',
        "show.py": '"""Results on the terminal."""\n',
        "other.py": '"""falconwing another: not the name of the file."""\n',
    }
    for name, text in files.items():
        (tmp_path / name).write_text(text)
    assert find_verbs(tmp_path) == (("my-verb", "my_verb", "MyVerb", "do it"),)


def test_a_closed_pipe_is_no_error():
    """`falconwing size | head -1`: the reader has gone before the first line."""
    words = [sys.executable, "-m", "falconwing_kit.tools.cli.main", "size"]
    run = subprocess.Popen(words, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    run.stdout.close()
    assert run.stderr.read() == "" and run.wait() == 0


def test_ctrl_c_is_one_word(monkeypatch, capsys):
    """Exit code 130, as a shell's own commands give it."""

    def interrupt(_):
        raise KeyboardInterrupt

    monkeypatch.setattr(Size, "run", interrupt)
    assert main(["size"]) == 130 and capsys.readouterr().err == "interrupted\n"
