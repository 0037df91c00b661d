"""One run of `falconwing demo`, which takes minutes, for all tests of what it writes and says."""

import contextlib
import io
import tempfile
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import NamedTuple

import pytest

from falconwing_kit.tools.cli.main import main
from falconwing_kit.tools.demo import approach, recorded
from falconwing_kit.tools.demo.approach import Approach
from falconwing_kit.tools.demo.recorded import RecordedFlights

WORDS = ("demo", "--headless", "--out", "out")  # as README prints them
_FOLDER = tempfile.TemporaryDirectory(prefix="falconwing_demo_", ignore_cleanup_errors=True)


class DemoRun(NamedTuple):
    """What came out of the verb."""

    code: int
    out: Path  # made by the verb
    printed: str
    complained: str  # on standard error
    found: RecordedFlights  # what the files were written from
    approach: Approach  # the landing before them


@cache
def demo_run() -> DemoRun:
    """The verb as it is typed, in an empty folder."""
    printed, complained, kept, flown = io.StringIO(), io.StringIO(), [], []
    study, fly, folder = recorded.study_recorded_flights, approach.fly_approach, Path(_FOLDER.name)
    with (
        pytest.MonkeyPatch.context() as patch,
        contextlib.chdir(folder),
        contextlib.redirect_stdout(printed),
        contextlib.redirect_stderr(complained),
    ):
        patch.setattr(
            recorded,
            "study_recorded_flights",
            lambda progress: kept.append(study(progress)) or kept[0],
        )
        patch.setattr(
            approach,
            "fly_approach",
            lambda *how, **more: flown.append(fly(*how, **more)) or flown[0],
        )
        code = main(WORDS)
    landing = replace(flown[0], log=folder / "out" / flown[0].log.name)
    return DemoRun(
        code, folder / "out", printed.getvalue(), complained.getvalue(), kept[0], landing
    )
