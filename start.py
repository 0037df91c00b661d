"""Install the kit in .venv and run a verb: its options in, its exit code out.

    python3 start.py demo [--headless] [--out DIR]   land in a simulated hall, model real flights
    python3 start.py test [pytest options]           run all tests; with options as pytest does
    python3 start.py VERB ...                        any other verb of falconwing, such as doctor

The first run creates .venv beside this file and installs the versions of constraints.txt; later
runs start immediately. Repeat the command after an interrupted installation. Only the standard
library is used.
"""

from __future__ import annotations

import hashlib
import importlib.util
import os
import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parent
NEW_PIP = "pip>=25"
KIT, EVERYTHING = ".", ".[labs,dev]"  # pip's targets for a verb and for the tests


def main(words: list[str]) -> int:
    """Install the verb's dependencies, then run it; its exit code, 2 if it could not be run."""
    too_old = python_problem(sys.version_info[:2])
    if too_old:
        return refuse(too_old)
    if not words or words[0] in ("-h", "--help"):
        print(__doc__)
        return 0 if words else 2
    verb, *options = words
    failed = install(ROOT, EVERYTHING if verb == "test" else KIT)
    if failed:
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


def install(root: Path, target: str) -> int:
    """Install a target into the virtual environment, unless it is installed already.

    Args:
        root: folder of pyproject.toml and constraints.txt.
        target: what pip installs, KIT or EVERYTHING.

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
    # remains after a kill: pip would take a partly written library for a complete one
    half_done.touch()
    # An older pip needs many minutes to add to an existing environment.
    failed = run([*pip, NEW_PIP]) or run([*pip, "-c", "constraints.txt", "-e", target], folder=root)
    if failed < 128:  # pip was not killed and cleaned up
        half_done.unlink()
    if failed:
        print(
            "start.py: the installation failed; if interrupted or without network, "
            "type the same command again",
            file=sys.stderr,
        )
        return failed
    # the tests' target includes the kit's
    installed = [KIT, EVERYTHING] if target == EVERYTHING else [KIT]
    stamp.write_text("\n".join(fingerprint(root, each) for each in installed))
    return 0


def fingerprint(root: Path, target: str) -> str:
    """Hash of folder, dependencies and target."""
    files = [(root / name).read_bytes() for name in ("pyproject.toml", "constraints.txt")]
    return hashlib.sha256(b"\0".join([*files, str(root).encode(), target.encode()])).hexdigest()


def venv_program(root: Path, name: str) -> str:
    """Path of a program in the virtual environment."""
    return str(root / ".venv" / ("Scripts" if os.name == "nt" else "bin") / name)


def answers(command: list[str]) -> bool:
    """Whether the command succeeds; its output is captured."""
    try:
        return subprocess.run(command, capture_output=True, check=False).returncode == 0
    except OSError:
        return False


def run(command: list[str], folder: Path | None = None) -> int:
    """Print the command, run it and return its exit code."""
    # on stderr, because stdout is the command's
    print("$", subprocess.list2cmdline(command), file=sys.stderr, flush=True)
    try:
        code = subprocess.run(command, cwd=folder, check=False).returncode
    except OSError as error:
        return refuse(f"cannot run {command[0]}: {error.strerror}")
    return code if code >= 0 else 128 - code  # killed by a signal: a shell's exit code


def refuse(sentence: str) -> int:
    """Print why nothing was run; the exit code of wrong use."""
    print(f"start.py: {sentence}", file=sys.stderr)
    return 2


if __name__ == "__main__":
    try:
        sys.exit(main(sys.argv[1:]))
    except KeyboardInterrupt:
        sys.exit(130)
