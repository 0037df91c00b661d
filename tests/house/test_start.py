"""start.py installs once, says what it runs, and hands over with the right words and exit code."""

import http.server
import importlib.util
import re
import shutil
import subprocess
import sys
import threading
from pathlib import Path

import pytest
from packaging.specifiers import SpecifierSet
from packaging.version import Version

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
    monkeypatch.delenv("FALCONWING_VERBOSE", raising=False)

    def note(command, folder=None, log=None, packages=0):
        module.commands.append(command)
        if "venv" in command:
            shutil.rmtree(tmp_path / ".venv", ignore_errors=True)
            (tmp_path / ".venv").mkdir()
        return next((code for word, code in module.exit_codes.items() if word in command), 0)

    monkeypatch.setattr(module, "ROOT", tmp_path)
    monkeypatch.setattr(module, "run", note)
    monkeypatch.setattr(module, "answers", lambda command, **_: (tmp_path / ".venv").is_dir())
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

    def killed(command, folder=None, log=None):
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
    assert ("expected Python" in error) != fine
    assert fine or ("3.11" in error and f"{version[0]}.{version[1]}" in error)
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


# PyTorch without CUDA
# --------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("system", "verb", "reached", "added"),
    [
        ("linux", "test", True, True),
        ("linux", "test", False, False),
        ("linux", "demo", True, False),
        ("darwin", "test", True, False),
        ("win32", "test", True, False),
    ],
)
def test_cpu_index_is_added_where_cuda_would_come(
    start, monkeypatch, capsys, system, verb, reached, added
):
    """By hand: on Linux alone, for PyTorch alone, and only if it answers; the choice is said."""
    (start.ROOT / ".venv").mkdir()
    monkeypatch.setattr(start.sys, "platform", system)
    monkeypatch.setattr(start, "answers", lambda command, **_: reached or "-c" not in command)
    assert start.main([verb]) == 0
    options = [word for command in start.commands for word in command if word.startswith("--extra")]
    assert len(options) == added
    assert all(option.endswith("=" + start.CPU_TORCH) for option in options)
    said = capsys.readouterr().err
    asked = system == "linux" and verb == "test"
    assert (start.CPU_TORCH in said, "2.7 GB" in said) == (asked, asked and not reached)


def test_pin_takes_the_cpu_build_before_the_other():
    """The packaging library, which pip uses: 2.13.0+cpu satisfies the pin and is the newer one."""
    pin = re.search(r"^torch(==\S+)$", (ROOT / "constraints.txt").read_text(), re.MULTILINE)[1]
    plain = pin.removeprefix("==")
    assert SpecifierSet(pin).contains(plain + "+cpu")
    assert Version(plain + "+cpu") > Version(plain)


def test_conda_file_installs_the_same():
    """Its lines for pip, which conda hands over in a file: index, pins and target of start.py."""
    start = load_start()
    lines = (ROOT / "environment.yml").read_text().split("- pip:\n")[1].splitlines()
    words = [line.strip().removeprefix("- ") for line in lines]
    option = start.CPU_OPTION.replace("=", " ", 1)
    assert words == [option, "-c constraints.txt", f"-e {start.EVERYTHING}"]


@pytest.mark.parametrize(
    ("server", "reached"), [("answers", True), ("refuses", False), ("is silent", False)]
)
def test_probe_ends_in_seconds(server, reached, monkeypatch):
    """Run for real against this machine: a page, an error, a server that accepts and is mute."""
    start = load_start()

    class Pages(http.server.BaseHTTPRequestHandler):
        def do_HEAD(self):
            if server == "is silent":
                silence.wait(30.0)
            self.send_response(200 if server == "answers" else 403)
            self.end_headers()

        def log_message(self, *_):
            pass

    silence = threading.Event()
    with http.server.ThreadingHTTPServer(("127.0.0.1", 0), Pages) as pages:
        pages.daemon_threads = True
        threading.Thread(target=pages.serve_forever, daemon=True).start()
        address = f"http://127.0.0.1:{pages.server_port}"
        monkeypatch.setenv("no_proxy", "127.0.0.1")
        monkeypatch.setattr(
            start, "PROBE", start.PROBE.replace("https://download.pytorch.org", address)
        )
        monkeypatch.setattr(start.sys, "platform", "linux")
        begin = start.time.monotonic()
        assert bool(start.cpu_torch()) == reached
        assert start.time.monotonic() - begin < 20.0  # a safety limit; pip's retries take minutes
        silence.set()
        pages.shutdown()


# Progress
# --------------------------------------------------------------------------------------------------

PIP = """Obtaining file:///kit
Collecting numpy==2.4.6 (from -c constraints.txt (line 1))
  Downloading numpy-2.4.6-cp311-linux.whl (16.9 MB)
Progress 8400000 of 16900000
"""


@pytest.mark.parametrize(
    ("output", "line"),
    [
        ("", "  0 %  starting"),
        ("Obtaining file:///a-b/kit\n", " 15 %  fetching the kit"),
        (PIP, " 30 %  fetching numpy, 8.4 of 16.9 MB"),
        (PIP + "Processing /wheels/torch-2.13.0+cpu-cp311.whl\n", " 45 %  fetching torch"),
        (PIP + "Collecting a\nCollecting b\nCollecting c\n", " 59 %  fetching c"),
        (PIP + "Installing collected packages: a, b, c, d\n", " 70 %  unpacking b"),
    ],
)
def test_progress_names_the_package_and_the_share(output, line):
    """By hand, of 4 packages: fetching is 60 % of the work, 2 of 4 are 30, one unpacked is 70."""
    assert load_start().progress(output, 4, 1) == line


def load_start():
    """start.py as a module that really runs its commands."""
    spec = importlib.util.spec_from_file_location("start_for_real", ROOT / "start.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_quiet_run_keeps_the_log_and_shows_its_end_on_failure(tmp_path, capsys):
    """Really run: nothing of a success on the terminal but the command; of a failure 20 lines."""
    start, log = load_start(), tmp_path / "install.log"
    log.write_text("before\n")
    many = [sys.executable, "-c", "[print('line', i) for i in range(100)]"]
    assert start.run(many, log=log) == 0
    assert capsys.readouterr().err.splitlines()[1:] == []
    assert log.read_text().splitlines()[0::100] == ["before", "line 99"]
    assert start.run([*many[:2], many[2] + "; print('Progress 1 of 2'); exit(3)"], log=log) == 3
    said = capsys.readouterr().err.splitlines()
    assert said[1:21] == [f"line {i}" for i in range(80, 100)]
    assert str(log) in said[21] and len(said) == 22


@pytest.mark.parametrize("how", ["word", "variable", "neither"])
def test_verbose_shows_pip(start, monkeypatch, how):
    """Without it pip writes to the log of .venv; `--verbose` after the verb is the verb's own."""
    logs, note = [], start.run
    if how == "variable":
        monkeypatch.setenv("FALCONWING_VERBOSE", "1")

    def watch(command, folder=None, log=None, packages=0):
        logs.append(log)
        return note(command, folder)

    monkeypatch.setattr(start, "run", watch)
    assert start.main([*(["--verbose"] if how == "word" else []), "size", "--verbose"]) == 0
    assert start.commands[-1][1:] == ["size", "--verbose"]
    assert set(logs) == (
        {None, start.ROOT / ".venv" / "install.log"} if how == "neither" else {None}
    )


def test_install_takes_the_parts_by_name(start, capsys):
    """The labs hold the kit, so a verb afterwards installs nothing; the tests hold the labs."""
    assert start.main(["install", "labs"]) == 0
    assert start.commands[-1][-1] == ".[labs]"
    said = capsys.readouterr().err
    assert re.search(r"fetches up to \d+ MB, takes about \d+ min", said) and "once" in said
    count = len(start.commands)
    assert start.main(["install"]) == start.main(["install", "kit"]) == 0
    assert len(start.commands) == count
    assert start.main(["install", "tests"]) == 0
    assert start.commands[-1][-1] == ".[labs,dev]"
    assert start.main(["install", "everything"]) == 2
    assert "expected one of kit, labs, tests, got everything" in capsys.readouterr().err
