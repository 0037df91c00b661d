"""The class's board: entries of lab 13 -> points, flown again in the grading sandbox.

An entry is JSON with the commands of a flight and the points that a student claims; no code. Its
commands drive lab 4's model of the course's aircraft in the sandbox, and lab 13's hidden reference
gives the points.
"""

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from falconwing_kit.core.checks import Array, InputError, require_file
from falconwing_kit.core.files import require_size
from falconwing_kit.tools.grading.collect import collect_source, read_notebook
from falconwing_kit.tools.grading.find import (
    lab_folder,
    load_checks,
    load_judges,
    load_module,
    notebook_path,
)
from falconwing_kit.tools.grading.lab import Course, Values, course_constants
from falconwing_kit.tools.grading.sandbox.host import (
    SandboxJob,
    StudentError,
    process_worker,
    sandbox_worker,
)

MAX_ENTRY = 1 << 20  # bytes
_MODEL = ("air_data", "body_force", "state_rate", "rk4_step")  # of lab 4
_FLY = """
import numpy
from given import K, body_rates


def fly_again(start, commands, floor, seconds):
    def rate(x, u):
        air = air_data(x, numpy.zeros(3))
        return state_rate(x, body_force(air, u, K), body_rates(air, u, K))

    states, before = [start], numpy.zeros(4)
    for command in commands:
        states.append(rk4_step(rate, states[-1], before, command, seconds))
        before = command
        if states[-1][2] <= floor:
            break
    return numpy.array(states)
"""


@dataclass(frozen=True)
class Placed:
    """One line of the board.

    Attributes:
        name: of the entry's file, without its ending.
        points: from flying the commands again; 0 if there is a problem.
        claimed: by the student; nan if not given.
        mine, of: how many functions are the student's, as the entry says.
        problem: why the entry was not flown; empty if it was.
    """

    name: str
    points: float
    claimed: float = float("nan")
    mine: int = 0
    of: int = 0
    problem: str = ""


def rank_entries(
    entries: Sequence[Path], key: str = "", labs: Path | None = None, *, sandboxed: bool = True
) -> list[Placed]:
    """Fly all entries again.

    Args:
        entries: files of the students, not trusted.
        key: the course's; empty for the open course.
        labs: folder with the kit's labs; found if None.
        sandboxed: False flies in plain processes.

    Returns:
        The board, best first; entries that cannot be flown last.

    Raises:
        FileNotFoundError: a file is missing.
        InputError: there is no sandbox here, or a lab of the kit is missing.
    """
    flight, model = lab_folder("lab13", labs), lab_folder("lab04", labs)
    constants = course_constants(load_checks(flight), key)
    given = load_module(flight, "given", constants)
    (judge,) = load_judges(flight, Course(constants))["landing_score"]
    assert isinstance(judge, Values)
    notebook = read_notebook(notebook_path(model, solution=True))
    job = SandboxJob(
        text="\n".join([*(collect_source(notebook, name).text for name in _MODEL), _FLY]),
        function="fly_again",
        folder=model,
        constants=course_constants(load_checks(model), key),
        seconds=10.0,
    )
    placed = []
    for path in entries:
        try:
            record, commands = _read_entry(path, given.STEPS)
            with (sandbox_worker if sandboxed else process_worker)(job) as worker:
                states = worker.call(given.START, commands, given.FLOOR_Z, given.STEP_S)
            points = float(judge.reference(_require_states(states))[3])
            placed.append(Placed(path.stem, points, *_claims(record)))
        except InputError as error:
            placed.append(Placed(path.stem, 0.0, problem=str(error)))
        except StudentError as error:
            placed.append(Placed(path.stem, 0.0, problem=f"the flight failed: {error.category}"))
    return sorted(placed, key=lambda one: (bool(one.problem), -one.points, one.name))


def _read_entry(path: Path, steps: int) -> tuple[Mapping[str, Any], Array]:
    """An entry's record, and its commands (n, 4) within their range."""
    require_size(require_file(path), MAX_ENTRY, "an entry")
    try:
        record = json.loads(path.read_text(encoding="utf-8"))
        commands = np.array(record["commands"], float)
    except (ValueError, KeyError, TypeError, RecursionError, OverflowError):
        raise InputError(
            f"{path.name}: expected lab 13's entry, JSON with commands; print it again"
        ) from None
    if commands.ndim != 2 or commands.shape[1] != 4 or not 2 <= len(commands) <= steps:
        raise InputError(
            f"{path.name}: expected (n, 4) commands, n from 2 to {steps}, got {commands.shape}; "
            "print the entry again"
        )
    if not np.isfinite(commands).all():
        raise InputError(f"{path.name}: expected finite commands, got nan or infinity; fly again")
    return record, np.clip(commands, [0.0, -1.0, -1.0, -1.0], 1.0)


def _require_states(states: Any) -> Array:
    if not isinstance(states, np.ndarray) or states.ndim != 2 or states.shape[1] != 9:
        raise StudentError("bad answer")
    return states


def _claims(record: Mapping[str, Any]) -> tuple[float, int, int]:
    """Claimed points, own functions, all functions; not trusted, shown only."""
    numbers = [record.get(name) for name in ("points", "mine", "of")]
    points, mine, of = (
        each if isinstance(each, int | float) and abs(each) < 1e6 else 0 for each in numbers
    )
    return float(points), int(mine), int(of)
