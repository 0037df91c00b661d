"""Leaderboard: judged flights -> the best of each name, kept in a folder over restarts.

Only what the kit's own judge found in a log counts; a page cannot send a score. The board holds
nicknames and nothing else about a person.
"""

import json
import math
import time
import unicodedata
from contextlib import suppress
from dataclasses import asdict, dataclass
from pathlib import Path
from threading import Lock
from typing import Any

from falconwing_kit.core.checks import InputError
from falconwing_kit.core.files import atomic_write
from falconwing_kit.tools.classroom.results import FlightRecord, Score, Verdict

FILE = "board.json"
VERSION = 1
LONGEST_NAME = 24  # characters of a nickname
MOST_ROWS = 500  # of one task
LARGEST_FILE = 4_000_000  # bytes; a longer file is not the board's
TASKS = {"landing": False, "follow": True}  # task -> whether more is better


@dataclass(frozen=True)
class Row:
    """The best of one name in one task."""

    name: str
    task: str
    score: float  # cm from the centre line, or s of the longest lock
    unit: str
    flight: int
    second: float | None = None  # of a landing the sink rate
    second_unit: str = ""


class Board:
    """The leaderboard of a folder: best landing, and longest lock on the leader."""

    def __init__(self, folder: str | Path) -> None:
        """Read the board of a folder, made if missing.

        A damaged file is kept beside the new one under another name; `damage` is then one sentence.

        Raises:
            InputError: the folder is a file, or may not be written.
        """
        self.folder, self.damage = Path(folder), ""
        self._rows: dict[tuple[str, str], Row] = {}
        self._lock = Lock()
        try:
            self.folder.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise InputError(
                f"{self.folder}: expected a folder for the board, got {error.strerror}; choose"
                " another one"
            ) from None
        self._read()

    @property
    def path(self) -> Path:
        """The board's file."""
        return self.folder / FILE

    def add(self, record: FlightRecord, verdict: Verdict) -> str:
        """Enter what a judged flight reached; one row for each name and task, its best.

        Args:
            record: the flight.
            verdict: of `results.judge`, from the log.

        Returns:
            One sentence: who entered or why nobody did.

        Raises:
            InputError: the disk is full, or the folder may not be written; the rows are kept in
                memory.
        """
        if not verdict.reproduced:
            return f"flight {record.number} is not on the board: {verdict.sentence}"
        if not verdict.scores:
            return f"flight {record.number} is not on the board: no student reached a score in it"
        said = []
        with self._lock:
            for score in verdict.scores:
                said.append(self._enter(record, score))
            self._write()
        return "; ".join(said)

    def rows(self, task: str = "") -> list[dict[str, Any]]:
        """The rows, best first, landings before locks, as the pages show them.

        Args:
            task: one of TASKS; empty for all.
        """
        with self._lock:
            rows = [row for row in self._rows.values() if task in ("", row.task)]
        return [asdict(row) for row in sorted(rows, key=_rank)]

    def _enter(self, record: FlightRecord, score: Score) -> str:
        name = nickname(score.name)
        if not name or score.task not in TASKS or not math.isfinite(score.value):
            return f"flight {record.number} has a score without a name or a task"
        second, unit = score.second or (None, "")
        row = Row(name, score.task, score.value, score.unit, record.number, second, unit)
        key = name.casefold(), score.task
        before = self._rows.get(key)
        text = f"{name}: {score.value:g} {score.unit}"
        if before is not None and _rank(before) <= _rank(row):
            return (
                f"{text}, the best stays {before.score:g} {before.unit} of flight {before.flight}"
            )
        self._rows[key] = row
        of_task = sorted((r for r in self._rows.values() if r.task == score.task), key=_rank)
        for last in of_task[MOST_ROWS:]:
            del self._rows[last.name.casefold(), last.task]
        return f"{text}, place {of_task.index(row) + 1} of {len(of_task)}"

    def _write(self) -> None:
        rows = [asdict(row) for row in self._rows.values()]
        with atomic_write(self.path, text=True) as file:
            json.dump({"version": VERSION, "rows": rows}, file, indent=1, allow_nan=False)

    def _read(self) -> None:
        if not self.path.exists():
            return
        try:
            if self.path.stat().st_size > LARGEST_FILE:
                raise ValueError("a file that is too long")
            content = json.loads(self.path.read_text(encoding="utf-8"))
            if content["version"] != VERSION:
                raise ValueError(f"version {content['version']!r}")
            rows = [_checked_row(row) for row in content["rows"]]
        except (OSError, ValueError, TypeError, KeyError, RecursionError) as error:
            kept = self.path.with_name(f"board_damaged_{time.time_ns()}.json")
            with suppress(OSError):
                self.path.replace(kept)
            self.damage = (
                f"{FILE}: expected the board of an earlier class, got another content ({error});"
                f" it is kept as {kept.name}, and a new board begins"
            )
            return
        self._rows = {(row.name.casefold(), row.task): row for row in rows}


def nickname(name: str) -> str:
    """A name as the board shows it: one line, at most 24 characters, no control characters."""
    visible = (c if unicodedata.category(c)[0] not in "CZ" else " " for c in str(name))
    return " ".join("".join(visible).split())[:LONGEST_NAME].strip()


def _rank(row: Row) -> tuple[int, float, float, int]:
    """Smaller is better; equal scores by the second number, then who was first."""
    more_is_better = TASKS[row.task]
    second = row.second if row.second is not None else math.inf
    score = -row.score if more_is_better else row.score
    return list(TASKS).index(row.task), score, second, row.flight


def _checked_row(values: dict[str, Any]) -> Row:
    """A row of the file; ValueError or TypeError for anything else."""
    row = Row(**values)
    numbers = [row.score, row.flight, *([] if row.second is None else [row.second])]
    if not all(type(x) in (int, float) and math.isfinite(x) for x in numbers):
        raise ValueError("a number that is none")
    texts = (row.name, row.task, row.unit, row.second_unit)
    if not all(isinstance(text, str) for text in texts) or row.task not in TASKS:
        raise ValueError("a row without name or task")
    if not row.name or row.name != nickname(row.name):
        raise ValueError("a name that is none")
    return row
