"""Importing a room is cheap: no heavy library comes along before a function needs it."""

import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
HEAVY = ("torch", "numba", "matplotlib", "control", "cv2", "viser", "gymnasium", "jsbsim")
ROOMS = sorted(path.parent.name for path in (ROOT / "falconwing_kit").glob("*/__init__.py"))


@pytest.mark.parametrize(
    "module",
    ["falconwing_kit", "falconwing_kit.tools.cli.main", *(f"falconwing_kit.{r}" for r in ROOMS)],
)
def test_import_loads_no_heavy_library(module):
    """A fresh Python says itself which modules it loaded."""
    assert heavy_after_import(module) == []


def test_help_of_the_command_loads_no_numpy():
    """The list of verbs is plain text; NumPy alone would cost more than the rest of it."""
    assert (
        loaded(
            "from falconwing_kit.tools.cli.main import main; main(['--help'])",
            ("numpy", "scipy", "tyro"),
        )
        == []
    )


def test_a_loaded_library_is_seen():
    """The check itself, on a module that is known to be loaded."""
    assert loaded("import numpy", ("numpy", "torch")) == ["numpy"]


def heavy_after_import(module: str) -> list[str]:
    """Names of the heavy libraries that an import brings along."""
    return loaded(f"import {module}", HEAVY)


def loaded(statement: str, names: tuple[str, ...]) -> list[str]:
    """Which of the named modules a fresh Python holds after a statement."""
    code = (
        f"import sys; {statement}; "
        f"print('loaded', *[name for name in {names!r} if name in sys.modules])"
    )
    done = subprocess.run(
        [sys.executable, "-c", code],
        cwd=ROOT,
        capture_output=True,
        text=True,
        timeout=120,
        check=True,
    )
    return done.stdout.splitlines()[-1].split()[1:]
