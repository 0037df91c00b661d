"""Virtual time for threads: a clock that stands until the test moves it, and then wakes its
sleepers one by one.
"""

import threading

PATIENCE = 20.0  # s of real time before a thread that neither sleeps nor ends counts as hung


class VirtualTime:
    """`now` and `sleep` for one thread under test; `advance` for the test."""

    def __init__(self) -> None:
        self._t, self._wake = 0.0, None
        self._open, self._change = True, threading.Condition()

    def now(self) -> float:
        """Virtual time [s]."""
        return self._t

    def sleep(self, seconds: float) -> None:
        """Sleep until the test lets time pass; at once after `release`."""
        with self._change:
            self._wake = wake = self._t + seconds
            self._change.notify_all()
            self._change.wait_for(lambda: self._t >= wake or not self._open)

    def advance(self, t: float) -> None:
        """Let time run to t [s]: the sleeper wakes at each of its times and runs until it sleeps
        again.
        """
        while True:
            with self._change:
                asleep = self._change.wait_for(
                    lambda: self._wake is not None and self._wake > self._t, PATIENCE
                )
                assert asleep, "the thread does not sleep"
                if self._wake > t:
                    self._t = t
                    return
                self._t, self._wake = self._wake, None
                self._change.notify_all()

    def release(self) -> None:
        """Nobody sleeps any more."""
        with self._change:
            self._open = False
            self._change.notify_all()

    # The same as a clock of `flight.loop`.
    def start(self) -> None:
        """Virtual time began already."""

    def wait_until(self, t: float) -> None:
        """The loop waits: time runs."""
        self.advance(max(t, self._t))
