"""Install the kit in .venv and run a verb: its options in, its exit code out.

    python3 start.py demo [--headless] [--out DIR]   land in a simulated hall, model real flights
    python3 start.py test [pytest options]           run all tests; with options as pytest does
    python3 start.py install labs                    install the labs' dependencies, run nothing
    python3 start.py VERB ...                        any other verb of falconwing, such as doctor

The first run creates .venv beside this file and installs the versions of constraints.txt; later
runs start immediately. pip's output goes to .venv/install.log; `--verbose` before the verb, or the
environment variable FALCONWING_VERBOSE=1, shows it. Repeat the command after an interrupted
installation. Only the standard library is used.
"""

from __future__ import annotations

import hashlib
import importlib.util
import os
import re
import shutil
import subprocess
import sys
import time
from pathlib import Path

ROOT = Path(__file__).resolve().parent
NEW_PIP = "pip>=25"
KIT, LABS, EVERYTHING = ".", ".[labs]", ".[labs,dev]"  # pip's targets, each part of the next
TARGETS = {"kit": KIT, "labs": LABS, "tests": EVERYTHING}
# MB to fetch, packages, minutes at 50 Mbit/s; tests/benchmarks/bench_install.py measures them
COSTS = {KIT: (220, 43, 1), LABS: (470, 132, 3), EVERYTHING: (840, 223, 5)}
# PyTorch without CUDA for Linux, where the public index has it with CUDA: 2.7 GB more
CPU_OPTION = "--extra-index-url=https://download.pytorch.org/whl/cpu"
CPU_TORCH = CPU_OPTION.partition("=")[2]
PROBE = f"""import urllib.request as web
web.urlopen(web.Request({CPU_TORCH + "/torch/"!r}, method="HEAD"), timeout=3).close()"""


def main(words: list[str]) -> int:
    """Install the verb's dependencies, then run it; its exit code, 2 if it could not be run."""
    too_old = python_problem(sys.version_info[:2])
    if too_old:
        return refuse(too_old)
    if not words or words[0] in ("-h", "--help"):
        print(__doc__)
        return 0 if words else 2
    verbose = words[0] == "--verbose" or os.environ.get("FALCONWING_VERBOSE", "0") not in ("", "0")
    verb, *options = (words[1:] if words[0] == "--verbose" else words) or ["install"]
    what = "tests" if verb == "test" else "kit"
    if verb == "install" and options:
        what = options[0]
        if len(options) > 1 or what not in TARGETS:
            return refuse(f"install: expected one of {', '.join(TARGETS)}, got {' '.join(options)}")
    failed = install(ROOT, TARGETS[what], verbose=verbose)
    if failed or verb == "install":
        return failed
    if verb == "test":
        codes = [run(command, folder=ROOT) for command in test_commands(options, cores())]
        return next((code for code in codes if code), 0)
    return run([venv_program(ROOT, "falconwing"), verb, *options])


def test_commands(options: list[str], processors: int) -> list[list[str]]:
    """Commands of the tests: pytest with the options; without options on two cores two commands.

    First two processes share the test files, then one process runs the tests that need the machine
    to themselves (tests/alone.py).
    """
    pytest = [venv_program(ROOT, "python"), "-m", "pytest"]
    if options or processors < 2:
        return [[*pytest, *options]]
    shared = [
        "-n",
        "2",
        "--dist",
        "loadfile",
        "--no-loadscope-reorder",
        "-m",
        "not benchmark and not alone",
    ]
    return [[*pytest, *shared], [*pytest, "-m", "alone and not benchmark"]]


def cores() -> int:
    """Number of processors available to this process."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def python_problem(version: tuple[int, ...]) -> str:
    """Why a Python version cannot be used; empty if it can."""
    if version >= (3, 11):
        return ""
    return (
        f"expected Python 3.11 or newer, this is {version[0]}.{version[1]}; "
        "install one and type python3.11 start.py"
    )


def install(root: Path, target: str, *, verbose: bool = False) -> int:
    """Install a target into the virtual environment, unless it is installed already.

    Args:
        root: folder of pyproject.toml and constraints.txt.
        target: what pip installs, of TARGETS.
        verbose: show pip's output in place of one line of progress.

    Returns:
        0, or the exit code of the step that failed.
    """
    stamp = root / ".venv" / "installed.txt"
    if stamp.exists() and fingerprint(root, target) in stamp.read_text().split():
        return 0
    python, half_done = venv_program(root, "python"), root / ".venv" / "half_done"
    if half_done.exists() or not answers([python, "-m", "pip", "--version"]):
        if not (importlib.util.find_spec("venv") and importlib.util.find_spec("ensurepip")):
            return refuse(
                "this Python has no venv module; on Debian or Ubuntu: apt install python3-venv"
            )
        failed = run([sys.executable, "-m", "venv", "--clear", str(root / ".venv")])
        if failed:
            return failed
    pip = [python, "-m", "pip", "install", "--disable-pip-version-check"]
    log = None if verbose else root / ".venv" / "install.log"
    if log:
        log.write_bytes(b"")
    # remains after a kill: pip would take a partly written library for a complete one
    half_done.touch()
    begin, (megabytes, packages, minutes) = time.monotonic(), COSTS[target]
    say(f"fetches up to {megabytes} MB, takes about {minutes} min at 50 Mbit/s; once")
    # An older pip needs many minutes to add to an existing environment.
    failed = run([*pip, NEW_PIP], log=log)
    if not failed:
        pip += [] if target == KIT else cpu_torch()
        pip += ["--progress-bar=raw"] if log else []
        failed = run([*pip, "-c", "constraints.txt", "-e", target], root, log, packages)
    if failed < 128:  # pip was not killed and cleaned up
        half_done.unlink()
    if failed:
        print(
            "start.py: the installation failed; if interrupted or without network, "
            "type the same command again",
            file=sys.stderr,
        )
        return failed
    parts = list(COSTS)
    installed = parts[: parts.index(target) + 1]
    stamp.write_text("\n".join(fingerprint(root, each) for each in installed))
    say(f"installed in {time.monotonic() - begin:.0f} s")
    return 0


def cpu_torch() -> list[str]:
    """pip's option for PyTorch's CPU builds: on Linux, and only if their index answers at once.

    pip would retry a silent index for every package, which takes minutes. Of the builds 2.13.0 and
    2.13.0+cpu pip takes the second, wherever it finds it.
    """
    if not sys.platform.startswith("linux"):
        return []  # the public index has the CPU build
    if answers([sys.executable, "-c", PROBE], limit_s=5.0):
        say(f"PyTorch without CUDA, from {CPU_TORCH}")
        return [CPU_OPTION]
    say(
        f"{CPU_TORCH} does not answer: pip takes the PyTorch that it finds elsewhere; from the "
        "public index that is 2.7 GB with CUDA"
    )
    return []


def fingerprint(root: Path, target: str) -> str:
    """Hash of folder, dependencies and target."""
    files = [(root / name).read_bytes() for name in ("pyproject.toml", "constraints.txt")]
    return hashlib.sha256(b"\0".join([*files, str(root).encode(), target.encode()])).hexdigest()


def venv_program(root: Path, name: str) -> str:
    """Path of a program in the virtual environment."""
    return str(root / ".venv" / ("Scripts" if os.name == "nt" else "bin") / name)


def answers(command: list[str], limit_s: float = 120.0) -> bool:
    """Whether the command succeeds within a time [s]; its output is captured."""
    try:
        done = subprocess.run(command, capture_output=True, timeout=limit_s, check=False)
    except (OSError, subprocess.TimeoutExpired):
        return False
    return done.returncode == 0


def run(
    command: list[str], folder: Path | None = None, log: Path | None = None, packages: int = 0
) -> int:
    """Print the command, run it and return its exit code.

    Args:
        command: program and its arguments.
        folder: to run it in; None for the current one.
        log: file for pip's output, with a line of progress on the terminal; None shows it.
        packages: about how many pip fetches; 0 shows no progress.
    """
    # on stderr, because stdout is the command's
    print("$", subprocess.list2cmdline(command), file=sys.stderr, flush=True)
    try:
        if log:
            code = run_quietly(command, folder, log, packages)
        else:
            code = subprocess.run(command, cwd=folder, check=False).returncode
    except OSError as error:
        return refuse(f"cannot run {command[0]}: {error.strerror}")
    return code if code >= 0 else 128 - code  # killed by a signal: a shell's exit code


def run_quietly(command: list[str], folder: Path | None, log: Path, packages: int) -> int:
    """Run pip with its output in a log: its exit code; if it failed, the log's end is printed."""
    live = sys.stderr.isatty()
    begin, period = time.time(), 0.5 if live else 10.0
    with log.open("ab") as file:
        size = file.tell()
        process = subprocess.Popen(command, cwd=folder, stdout=file, stderr=subprocess.STDOUT)
        try:
            while (code := process.poll()) is None:
                try:
                    process.wait(period)
                except subprocess.TimeoutExpired:
                    if not packages:
                        continue
                    text = log.read_bytes()[size:].decode("utf-8", "replace")
                    show(progress(text, packages, unpacked(log.parent, begin)), live)
        finally:
            process.kill()  # after Ctrl-C; nothing if it has ended
    if live:
        show("", live)
    if code:
        lines = log.read_text(encoding="utf-8", errors="replace").splitlines()
        end = [line for line in lines if not line.startswith("Progress ")][-20:]
        print(*end, f"start.py: the whole output is in {log}", sep="\n", file=sys.stderr)
    return code


def progress(output: str, packages: int, finished: int) -> str:
    """What pip does, in one line, from its output so far.

    Args:
        output: of pip with `--progress-bar=raw`.
        packages: about how many it fetches.
        finished: packages that are unpacked.
    """
    unpacking = re.findall(r"^Installing collected packages: (.*)", output, re.MULTILINE)
    if unpacking:
        names = unpacking[-1].split(", ")
        done = min(finished, len(names) - 1)
        return f"{60 + 40 * done // len(names):3d} %  unpacking {names[done]}"
    names = re.findall(r"^(?:Collecting|Processing|Obtaining) (\S+)", output, re.MULTILINE)
    if not names:
        return "  0 %  starting"
    share = min(60 * len(names) // max(packages, 1), 59)
    name = re.split(r"[<>=!~;\[-]", re.split(r"[/\\]", names[-1])[-1])[0]
    name = "the kit" if names[-1].startswith("file:") else name
    last = output.splitlines()[-1]
    part = re.fullmatch(r"Progress (\d+) of (\d+)", last)
    size = f", {int(part[1]) / 1e6:.1f} of {int(part[2]) / 1e6:.1f} MB" if part else ""
    return f"{share:3d} %  fetching {name}{size}"


def unpacked(venv: Path, since: float) -> int:
    """Number of packages unpacked into the virtual environment since a time [s]."""
    found = [*venv.glob("lib/python*/site-packages/*.dist-info")]
    found += [*venv.glob("Lib/site-packages/*.dist-info")]
    return sum(each.stat().st_mtime >= since for each in found)


def show(line: str, live: bool) -> None:
    """One line of progress: in place on a terminal, else a line of its own."""
    width = shutil.get_terminal_size().columns - 1
    end = {"end": "\r"} if live else {}
    print(f"{line[:width]:<{width if live else 0}}", file=sys.stderr, flush=True, **end)


def say(sentence: str) -> None:
    """Print a sentence beside the commands."""
    print(f"start.py: {sentence}", file=sys.stderr, flush=True)


def refuse(sentence: str) -> int:
    """Print why nothing was run; the exit code of wrong use."""
    say(sentence)
    return 2


if __name__ == "__main__":
    try:
        sys.exit(main(sys.argv[1:]))
    except KeyboardInterrupt:
        sys.exit(130)
