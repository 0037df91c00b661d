"""One run of `falconwing demo` that all tests of its files and words share: it takes a quarter of a minute."""

import contextlib
import io
import tempfile
from functools import cache
from pathlib import Path
from typing import NamedTuple

import pytest

from falconwing_kit.cli.main import main
from falconwing_kit.demo import recorded
from falconwing_kit.demo.recorded import RecordedFlights

WORDS = ("demo", "--headless", "--out", "out")  # as README prints them
_FOLDER = tempfile.TemporaryDirectory(prefix="falconwing_demo_", ignore_cleanup_errors=True)


class DemoRun(NamedTuple):
    """What came out of the verb."""

    code: int
    out: Path  # made by the verb
    printed: str
    complained: str  # on standard error
    found: RecordedFlights  # what the files were written from


@cache
def demo_run() -> DemoRun:
    """The verb as it is typed, in an empty folder."""
    printed, complained, kept = io.StringIO(), io.StringIO(), []
    study, folder = recorded.study_recorded_flights, Path(_FOLDER.name)
    with (
        pytest.MonkeyPatch.context() as patch,
        contextlib.chdir(folder),
        contextlib.redirect_stdout(printed),
        contextlib.redirect_stderr(complained),
    ):
        patch.setattr(recorded, "study_recorded_flights", lambda progress: kept.append(study(progress)) or kept[0])
        code = main(WORDS)
    return DemoRun(code, folder / "out", printed.getvalue(), complained.getvalue(), kept[0])
