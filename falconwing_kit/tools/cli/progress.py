"""Progress of a long verb: names of its stages -> a line in place on a terminal, else a line at
least every ten seconds.
"""

import shutil
import sys
import threading
import time
from collections.abc import Callable, Sequence
from types import TracebackType
from typing import TextIO

PERIOD_S = 10.0  # without a terminal, a line at least this often
SETTLED = 0.1  # share done, from which on the time left is estimated


class StageProgress:
    """The current stage of a verb, its share done and the time left, on standard error.

    Args:
        verb: begins each line.
        stages: begin of a stage's name and the share done before it, 0 to 1, rising; other stages
            leave the share as it is.
        stream: None for standard error.
        now: the clock [s].
    """

    def __init__(
        self,
        verb: str,
        stages: Sequence[tuple[str, float]],
        stream: TextIO | None = None,
        now: Callable[[], float] = time.monotonic,
    ) -> None:
        self._verb, self._stages, self._now = verb, stages, now
        self._stream = stream or sys.stderr
        self._live = self._stream.isatty()
        self._begin = self._printed = now()
        self._stage, self._wide = "", 0
        self._share, self._reached = 0.0, 0.0  # of the last stage that has one, and when [s]
        self._done, self._lock = threading.Event(), threading.Lock()

    def __enter__(self) -> "StageProgress":
        """Print from a thread, since a stage may compute for a minute."""
        self._thread = threading.Thread(target=self._watch, name="progress", daemon=True)
        self._thread.start()
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        """Stop, and clear the line of a terminal."""
        self._done.set()
        self._thread.join()
        self._clear()

    def __call__(self, stage: str) -> None:
        """A stage begins."""
        with self._lock:
            self._stage = stage
            shares = [share for name, share in self._stages if stage.startswith(name)]
            if max(shares, default=0.0) > self._share:
                self._share, self._reached = max(shares), self._now() - self._begin
        self.tick(0.5 * PERIOD_S)

    def write(self, text: str) -> None:
        """Print a result on standard output, above the line of a terminal."""
        self._clear()
        print(text, flush=True)

    def tick(self, quiet_s: float = PERIOD_S) -> None:
        """Print the line: on a terminal always, else if this time [s] has passed since the last."""
        with self._lock:
            if self._live:
                self._put(self.line())
            elif self._now() - self._printed >= quiet_s:
                self._printed = self._now()
                print(self.line(), file=self._stream, flush=True)

    def line(self) -> str:
        """Such as "demo: 40 %, 31 s, about 50 s left: real flight, fold 2 of 4"."""
        passed = self._now() - self._begin
        share, left = self._share_at(passed), ""
        if share >= SETTLED:
            rest = passed * (1.0 / share - 1.0)
            left = f", about {max(10, round(rest, -1)):.0f} s left"
        return f"{self._verb}: {100.0 * share:.0f} %, {passed:.0f} s{left}: {self._stage}"

    def _share_at(self, passed: float) -> float:
        """The share done after a time [s]: within a stage it grows as fast as on average before,
        up to nine tenths of the way to the next.
        """
        if self._reached <= 0.0:
            return self._share
        higher = min([1.0, *(share for _, share in self._stages if share > self._share)])
        grown = self._share * passed / self._reached
        return min(grown, self._share + 0.9 * (higher - self._share))

    def _watch(self) -> None:
        while not self._done.wait(0.5):
            self.tick()

    def _put(self, text: str) -> None:
        text = text[: shutil.get_terminal_size().columns - 1]
        print(f"\r{text:<{self._wide}}", end="", file=self._stream, flush=True)
        self._wide = len(text)

    def _clear(self) -> None:
        with self._lock:
            if self._wide:
                self._put("")
                print("\r", end="", file=self._stream, flush=True)
                self._wide = 0
