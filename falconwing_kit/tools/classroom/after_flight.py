"""After a flight: its log -> verdict, player's data, share page, board, answer of `gap`.

The parts that compute these are files of their own, loaded when they are first needed and left out
where this version does not have them: the live verdict of the task's own judge needs none.
"""

import importlib
import importlib.util
import json
import math
import multiprocessing
import os
import signal
import threading
from collections.abc import Callable
from concurrent.futures import BrokenExecutor, ProcessPoolExecutor
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path
from typing import Any

from falconwing_kit.flight.trial import FlightTask, TrialSetup
from falconwing_kit.tools.classroom.channel import plain

ROOM = "falconwing_kit.tools.classroom"
PATIENCE_S = 120.0  # for an answer
MAX_DATA = 20  # flights whose data are kept


@cache
def part(name: str) -> Any:
    """A module by its full name, or None where this version does not have it."""
    return importlib.import_module(name) if importlib.util.find_spec(name) else None


@dataclass(frozen=True)
class FlightRecord:
    """A flown flight: its number, its log, and what its judge needs."""

    number: int
    log: Path
    task: str
    manoeuvre: str
    scene: str
    seed: int
    autopilot: str
    holders: tuple[str, ...]  # names of the students that flew, in their order
    effects: tuple[str, ...]  # on at the end


@dataclass(frozen=True)
class Verdict:
    """A judge's answer."""

    sentence: str
    success: bool | None
    numbers: dict[str, tuple[float, str]] = field(default_factory=dict)  # label -> value, unit


def live_verdict(
    task: FlightTask, trial: TrialSetup, result: dict[str, Any], reason: str
) -> Verdict:
    """The verdict of the task's own judge right after a flight.

    Args:
        task: that was flown.
        trial: its world, for what was touched.
        result: of the judge.
        reason: why the loop ended.
    """
    success = bool(result.get("success"))
    if trial.leader is not None:
        return _following(result, reason, success)
    numbers: dict[str, tuple[float, str]] = {}
    if "sink_rate_m_s" in result:
        numbers = {
            "from the centre line": (100.0 * result["lateral_offset_m"], "cm left"),
            "past the threshold": (result["past_threshold_m"], "m"),
            "sink rate": (result["sink_rate_m_s"], "m/s"),
            "speed": (result["speed_m_s"], "m/s"),
            "bank": (result["bank_deg"], "deg"),
        }
    contact = trial.world.contact
    if contact is None:
        how = "the pilot failed" if reason == "pilot failed" else "the time was over"
        return Verdict(f"Not landed: {how}.", False, numbers)
    if success:
        offset, sink = result["lateral_offset_m"], result["sink_rate_m_s"]
        side = "left" if offset > 0.0 else "right"
        return Verdict(
            f"On the pad, {100.0 * abs(offset):.0f} cm {side} of the centre line, {sink:.2f} m/s"
            " sink rate.",
            True,
            numbers,
        )
    if contact.touchdown is not None:
        return Verdict("Landed beside the pad.", False, numbers)
    return Verdict(f"Touched the {contact.obstacle}.", False, numbers)


def _following(result: dict[str, Any], reason: str, success: bool) -> Verdict:
    share, error = result["locked_share"], result.get("ate_path_m")
    numbers = {"in view": (100.0 * share, "% of the flight")}
    if error is not None and math.isfinite(error):
        numbers["distance from its place"] = (error, "m")
    if success:
        return Verdict("The leader was in view until its flight ended.", True, numbers)
    lost = result.get("lost_at_s")
    if lost is not None:
        return Verdict(f"The leader was out of view after {lost:.1f} s.", False, numbers)
    return Verdict(f"The flight ended early: {reason}.", False, numbers)


class AfterFlight:
    """What is computed after a flight, in processes of its own; None where its part is missing."""

    def __init__(self, folder: Path) -> None:
        """folder: of the logs, where the board keeps its file."""
        self._lock = threading.Lock()
        self._pool: ProcessPoolExecutor | None = None
        self._data: dict[int, bytes] = {}
        self._gap = threading.Semaphore(1)
        board = part(f"{ROOM}.board")
        self._board = None if board is None else board.Board(folder)

    def close(self) -> None:
        """End the processes without waiting for their answers."""
        with self._lock:
            pool, self._pool = self._pool, None
        if pool is not None:
            pool.shutdown(wait=False, cancel_futures=True)

    def add(self, record: FlightRecord) -> list[dict[str, Any]] | None:
        """Judge a flight again from its log and enter it; the board's rows."""
        if self._board is None or part(f"{ROOM}.results") is None:
            return None
        verdict = self._compute("judge", record)
        self._board.add(_own(record), verdict)
        rows: list[dict[str, Any]] = self._board.rows()
        return rows

    def data(self, record: FlightRecord) -> bytes | None:
        """The player's data as JSON, computed once."""
        if part(f"{ROOM}.results") is None:
            return None
        if record.number not in self._data:
            found = self._compute("flight_data", record)
            self._data[record.number] = json.dumps(
                plain(found), allow_nan=False, separators=(",", ":")
            ).encode()
            for old in sorted(self._data)[:-MAX_DATA]:
                del self._data[old]
        return self._data[record.number]

    def share_page(self, record: FlightRecord, scene: bytes | None) -> str | None:
        """The share file of a flight."""
        share = part(f"{ROOM}.share")
        if share is None or scene is None:
            return None
        page: str = share.share_page(_own(record), scene)
        return page

    def name_missing(self, record: FlightRecord, answer: Callable[[dict[str, Any]], None]) -> None:
        """Run `gap` on a flight in another process; answers come as it begins and ends."""

        def refuse(sentence: str) -> None:
            answer({"flight": record.number, "state": "failed", "sentence": sentence, "report": {}})

        if part(f"{ROOM}.results") is None:
            refuse("This version cannot run gap from the page; use falconwing gap.")
            return
        if not self._gap.acquire(blocking=False):
            refuse("Another flight is being examined; ask again when its answer is there.")
            return

        def work() -> None:
            try:
                report = self._compute("name_missing", record, None, None)
                sentence = str(report.get("sentence", ""))
                answer({"flight": record.number, "state": "done", "sentence": sentence,
                        "report": plain(report)})  # fmt: skip
            except Exception as error:
                refuse(str(error))
            finally:
                self._gap.release()

        answer({"flight": record.number, "state": "running", "report": {},
                "sentence": "gap examines the flight, at most 30 s."})  # fmt: skip
        threading.Thread(target=work, name="gap", daemon=True).start()

    def _compute(self, function: str, record: FlightRecord, *arguments: Any) -> Any:
        """The answer of a function of results.py, computed in another process."""
        with self._lock:
            if self._pool is None:
                context = multiprocessing.get_context("spawn")
                self._pool = ProcessPoolExecutor(2, context, _begin_process)
            future = self._pool.submit(_answer, function, record, *arguments)
        try:
            return future.result(PATIENCE_S)
        except BrokenExecutor:
            self.close()
            raise


def _begin_process() -> None:
    """Ctrl-C ends the class, which ends its processes; the flight has the machine first."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    if hasattr(os, "nice"):
        os.nice(10)


def _answer(function: str, record: FlightRecord, *arguments: Any) -> Any:
    return getattr(part(f"{ROOM}.results"), function)(_own(record), *arguments)


def _own(record: FlightRecord) -> Any:
    """The record as results.py defines it."""
    results = part(f"{ROOM}.results")
    own = getattr(results, "FlightRecord", None)
    return record if own is None else own(**vars(record))
