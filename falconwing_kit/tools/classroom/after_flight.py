"""After a flight: its log -> player's data, share page, board, answer of `gap`.

They are computed in other processes, so that the next flight keeps its 20 Hz.
"""

import json
import multiprocessing
import os
import signal
import threading
from collections.abc import Callable
from concurrent.futures import BrokenExecutor, ProcessPoolExecutor
from pathlib import Path
from typing import Any

from falconwing_kit.tools.classroom import results
from falconwing_kit.tools.classroom.board import Board
from falconwing_kit.tools.classroom.channel import plain
from falconwing_kit.tools.classroom.results import FlightRecord
from falconwing_kit.tools.classroom.share import share_page

PATIENCE_S = 120.0  # for an answer
MAX_DATA = 20  # flights whose data are kept


class AfterFlight:
    """What is computed after a flight, in processes of its own."""

    def __init__(self, folder: Path) -> None:
        """folder: of the logs, where the board keeps its file."""
        self._lock = threading.Lock()
        self._pool: ProcessPoolExecutor | None = None
        self._is_closed = False
        self._data: dict[int, bytes] = {}
        self._gap = threading.Semaphore(1)
        self._board = Board(folder)

    def warm(self) -> None:
        """Begin a process before it is needed: the first answer comes within a second too."""
        with self._lock:
            self._begin().submit(os.getpid)

    def close(self) -> None:
        """End the processes without waiting for their answers."""
        with self._lock:
            self._is_closed = True
        self._end_pool()

    def _end_pool(self) -> None:
        with self._lock:
            pool, self._pool = self._pool, None
        if pool is not None:
            processes = list((pool._processes or {}).values())
            pool.shutdown(wait=False, cancel_futures=True)
            for process in processes:  # which would else be waited for when Python ends
                process.terminate()

    def add(self, record: FlightRecord) -> list[dict[str, Any]]:
        """Judge a flight again from its log and enter it; the board's rows."""
        verdict = self._compute("judge", record)
        self._board.add(record, verdict)
        return self._board.rows()

    def data(self, record: FlightRecord) -> bytes:
        """The player's data as JSON, computed once."""
        if record.number not in self._data:
            found = self._compute("flight_data", record)
            self._data[record.number] = json.dumps(
                plain(found), allow_nan=False, separators=(",", ":")
            ).encode()
            for old in sorted(self._data)[:-MAX_DATA]:
                del self._data[old]
        return self._data[record.number]

    def share_page(self, record: FlightRecord, scene: bytes | None) -> str:
        """The share file of a flight."""
        return share_page(record, scene)

    def name_missing(self, record: FlightRecord, answer: Callable[[dict[str, Any]], None]) -> None:
        """Run `gap` on a flight in another process; answers come as it begins and ends."""

        def refuse(sentence: str) -> None:
            answer({"flight": record.number, "state": "failed", "sentence": sentence, "report": {}})

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
                "sentence": "gap examines the flight: half a minute, longer if slow."})  # fmt: skip
        threading.Thread(target=work, name="gap", daemon=True).start()

    def _compute(self, function: str, record: FlightRecord, *arguments: Any) -> Any:
        """The answer of a function of results.py, computed in another process."""
        with self._lock:
            future = self._begin().submit(_answer, function, record, *arguments)
        try:
            return future.result(PATIENCE_S)
        except BrokenExecutor:
            self._end_pool()  # the next question begins new ones
            raise

    def _begin(self) -> ProcessPoolExecutor:
        """The processes; called with the lock."""
        if self._is_closed:
            raise RuntimeError("the class has ended")
        if self._pool is None:
            # While another thread imports OpenCV, sys.path holds OpenCV's own folder, whose
            # `typing` breaks a process that takes over this path: wait for the end of the import.
            import cv2  # noqa: F401

            context = multiprocessing.get_context("spawn")
            self._pool = ProcessPoolExecutor(2, context, _begin_process)
        return self._pool


def _begin_process() -> None:
    """Ctrl-C ends the class, which ends its processes; the flight has the machine first."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    if hasattr(os, "nice"):
        os.nice(10)


def _answer(function: str, record: FlightRecord, *arguments: Any) -> Any:
    return getattr(results, function)(record, *arguments)
