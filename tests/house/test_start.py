"""start.py installs once, says what it runs, and hands over with the right words and exit code."""

import importlib.util
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]


@pytest.fixture
def start(tmp_path, monkeypatch):
    """start.py as a module that works in a folder of its own and writes down its commands instead
    of running them.
    """
    spec = importlib.util.spec_from_file_location("start_under_test", ROOT / "start.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    for name in ("pyproject.toml", "constraints.txt"):
        (tmp_path / name).write_text(name)
    module.commands, module.exit_codes = [], {}

    def note(command, folder=None):
        module.commands.append(command)
        if "venv" in command:
            shutil.rmtree(tmp_path / ".venv", ignore_errors=True)
            (tmp_path / ".venv").mkdir()
        return next((code for word, code in module.exit_codes.items() if word in command), 0)

    monkeypatch.setattr(module, "ROOT", tmp_path)
    monkeypatch.setattr(module, "run", note)
    monkeypatch.setattr(module, "answers", lambda command: (tmp_path / ".venv").is_dir())
    return module


def test_first_run_makes_installs_and_hands_over(start):
    """The steps of the manual installation, in order, and a newer pip before the kit."""
    assert start.main(["demo", "--headless"]) == 0
    assert start.commands[0][-3:-1] == ["venv", "--clear"]
    assert start.commands[1][-1].startswith("pip>=")
    assert start.commands[2][-4:] == ["-c", "constraints.txt", "-e", "."]
    assert start.commands[3][1:] == ["demo", "--headless"]
    assert Path(start.commands[3][0]).name == "falconwing"


def test_second_run_only_hands_over(start):
    """Nothing changed in between, so nothing is installed twice."""
    start.main(["demo"])
    start.commands.clear()
    start.main(["doctor"])
    assert [command[1:] for command in start.commands] == [["doctor"]]


def test_tests_bring_their_extras_and_then_serve_verbs_too(start):
    """The tests' set holds the kit, so a verb afterwards installs nothing; the other way round pip
    runs again.
    """
    start.main(["demo"])
    start.main(["test", "-q"])
    assert start.commands[-2][-1] == ".[labs,dev]"
    assert start.commands[-1][1:] == ["-m", "pytest", "-q"]
    start.commands.clear()
    start.main(["size"])
    assert len(start.commands) == 1


def test_all_tests_run_two_at_a_time_where_there_are_two_cores(start, monkeypatch):
    """Then those that need the machine alone, whatever came out before; with options or one core
    pytest has its way.
    """
    start.exit_codes["-n"] = 1
    monkeypatch.setattr(start, "cores", lambda: 2)
    assert start.main(["test"]) == 1
    shared, alone = start.commands[-2:]
    assert shared[1:5] == ["-m", "pytest", "-n", "2"] and "not alone" in shared[-1]
    assert alone[1:4] == ["-m", "pytest", "-m"] and alone[-1].startswith("alone")
    assert start.main(["test", "-k", "trim"]) == 0
    assert start.commands[-1][1:] == ["-m", "pytest", "-k", "trim"]
    monkeypatch.setattr(start, "cores", lambda: 1)
    assert start.main(["test"]) == 0
    assert start.commands[-1][1:] == ["-m", "pytest"]


@pytest.mark.parametrize("name", ["pyproject.toml", "constraints.txt"])
def test_changed_dependencies_are_installed(start, tmp_path, name):
    """A pull that brings other versions must reach the environment, without making it anew."""
    start.main(["demo"])
    start.commands.clear()
    (tmp_path / name).write_text("changed")
    start.main(["demo"])
    assert ["install" in command for command in start.commands] == [True, True, False]


def test_interrupted_install_goes_on_and_its_exit_code_comes_out(start, capsys):
    """pip fails: its code comes out, the verb is not run, no stamp stays; the next run goes on with
    pip.
    """
    start.exit_codes["install"] = 7
    assert start.main(["demo"]) == 7
    assert "same command again" in capsys.readouterr().err
    start.exit_codes.clear()
    start.commands.clear()
    assert start.main(["demo"]) == 0
    assert ["install" in command for command in start.commands] == [True, True, False]


def test_killed_install_starts_from_an_empty_environment(start, monkeypatch):
    """A library that was half written when pip was killed looks installed to pip; only a new
    environment is sure.
    """

    def killed(command, folder=None):
        raise KeyboardInterrupt

    (start.ROOT / ".venv").mkdir()
    with monkeypatch.context() as patch, pytest.raises(KeyboardInterrupt):
        patch.setattr(start, "run", killed)
        start.main(["demo"])
    assert start.main(["demo"]) == 0
    assert "--clear" in start.commands[0]
    assert "install" in start.commands[1]
    start.commands.clear()
    start.main(["demo"])
    assert len(start.commands) == 1


def test_exit_code_of_the_verb_comes_out(start):
    """1 means that the answer is no; it must not be swallowed."""
    start.exit_codes["doctor"] = 1
    assert start.main(["doctor"]) == 1


@pytest.mark.parametrize(
    ("version", "fine"), [((3, 10), False), ((2, 7), False), ((3, 11), True), ((3, 13), True)]
)
def test_old_python_is_refused_in_one_sentence(start, monkeypatch, capsys, version, fine):
    """3.11 is the first that reads TOML by itself; the sentence names both versions."""
    monkeypatch.setattr(start.sys, "version_info", (*version, 0))
    assert start.main(["demo"]) == (0 if fine else 2)
    error = capsys.readouterr().err
    assert (error == "") if fine else ("3.11" in error and f"{version[0]}.{version[1]}" in error)
    assert bool(start.commands) == fine


def test_missing_venv_is_said_in_one_sentence(start, monkeypatch, capsys):
    """Debian leaves ensurepip out of its Python; the package that brings it is python3-venv."""
    monkeypatch.setattr(start.importlib.util, "find_spec", lambda name: None)
    assert start.main(["demo"]) == 2
    assert "python3-venv" in capsys.readouterr().err
    assert start.commands == []


def test_command_is_said_and_signal_counts_as_in_a_shell():
    """Really run: the line begins with $, an exit code passes through, signal 9 gives 128 + 9."""
    code = "import start; {}; print(start.run([start.sys.executable, '-c', {!r}]))"
    for program, expected in (("exit(3)", "3"), ("import os; os.kill(os.getpid(), 9)", "137")):
        if "kill" in program and sys.platform == "win32":
            continue
        done = subprocess.run(
            [sys.executable, "-c", code.format("0", program)],
            cwd=ROOT,
            capture_output=True,
            text=True,
            check=True,
        )
        assert done.stderr.startswith(f"$ {sys.executable} -c ")
        assert done.stdout == f"{expected}\n"


@pytest.mark.parametrize(("words", "code"), [(["--help"], 0), ([], 2)])
def test_help_names_both_commands(words, code):
    """Run for real; help alone installs nothing."""
    done = subprocess.run(
        [sys.executable, "start.py", *words], cwd=ROOT, capture_output=True, text=True, check=False
    )
    assert done.returncode == code
    assert "start.py demo" in done.stdout
    assert "start.py test" in done.stdout
