"""Device clock: a board with a known clock answers through a line with known delays; the truth is
known to the test.
"""

import math

import numpy as np
import pytest

from falconwing_kit.trainer_port.clock import BYTE_S, MAX_DRIFT, DeviceClock

WRAP = 2**32


class Board:
    """A clock that shows `start` at host time 0 and runs fast by `drift`; its line delays each way
    by some time.
    """

    def __init__(self, start: float, drift: float, seed: int = 0) -> None:
        self.start, self.drift = start, drift
        self.random = np.random.default_rng(seed)

    def shows(self, host: float) -> int:
        """Its 32 bits at a host time [us]."""
        return round((self.start + host * (1.0 + self.drift)) * 1e6) % WRAP

    def answer(self, clock: DeviceClock, t: float, there: float, back: float) -> bool:
        """One round trip with these delays besides the bytes on the wire, and 0.1 ms of work."""
        received = t + 9 * BYTE_S + there
        read = received + 1e-4 + back + 17 * BYTE_S
        return clock.add(t, self.shows(received), self.shows(received + 1e-4), read)

    def answer_often(self, clock: DeviceClock, times: np.ndarray) -> None:
        """Round trips through a line that is usually a millisecond slow and sometimes thirty."""
        for t in times:
            slow = self.random.random(2) < 0.2
            there, back = (
                self.random.exponential(1e-3, 2) + 1e-4 + slow * self.random.uniform(0.0, 30e-3, 2)
            )
            self.answer(clock, float(t), float(there), float(back))


def error(clock: DeviceClock, board: Board, host: float) -> float:
    """What the clock is wrong by at a host time [s]."""
    return clock.to_host(board.shows(host)) - host


@pytest.mark.parametrize("drift", [-5e-3, 0.0, 30e-6, 5e-3])
@pytest.mark.parametrize("start", [0.5, 3000.0, 4294.0])
def test_device_times_are_found_within_half_a_millisecond_and_the_bound(drift, start):
    """Truth: the board's own line, which wraps at 4294.97 s. The mean of two delays of 1 ms in each
    group's fastest trip errs by some 0.1 ms; half a millisecond is five times that. Never beyond
    the bound, which is a law.
    """
    board, clock = Board(start, drift), DeviceClock()
    board.answer_often(clock, np.arange(0.0, 120.0, 0.5))
    for host in np.linspace(60.0, 125.0, 40):
        assert abs(error(clock, board, host)) < 0.5e-3
        assert abs(error(clock, board, host)) <= clock.error_bound(board.shows(host)) < 5e-3


def test_drift_is_found():
    """By law: two minutes with errors of 0.2 ms leave a few 1e-6; 20 is allowed, and the drift
    itself is 800.
    """
    board, clock = Board(10.0, 800e-6), DeviceClock()
    board.answer_often(clock, np.arange(0.0, 120.0, 0.5))
    assert clock.drift_ppm == pytest.approx(800.0, abs=20.0)


def test_errors_never_exceed_the_bound_of_a_young_clock():
    """The bound holds from the first round trip on, for each of 200 lines with different delays."""
    for seed in range(200):
        board, clock = Board(4290.0, 0.4 * MAX_DRIFT * (-1) ** seed, seed), DeviceClock()
        for k in range(20):
            board.answer_often(clock, np.array([0.2 * k]))
            for later in (0.0, 0.1, 10.0):
                host = 0.2 * k + later
                assert abs(error(clock, board, host)) <= clock.error_bound(board.shows(host)), (
                    seed,
                    k,
                    later,
                )


def test_a_constant_asymmetry_stays_within_the_bound():
    """By hand: 0 ms there and 10 ms back shift the midpoint by 5 ms, half of the latency."""
    board, clock = Board(1.0, 0.0), DeviceClock()
    for k in range(100):
        board.answer(clock, 0.5 * k, 0.0, 10e-3)
    assert error(clock, board, 40.0) == pytest.approx(5e-3, abs=1e-5)
    assert clock.error_bound(board.shows(40.0)) == pytest.approx(5e-3, abs=2e-5)


def test_bytes_on_the_wire_are_no_asymmetry():
    """By hand: without other delays the middle is exact up to the rounding to microseconds, the
    round trip zero.
    """
    board, clock = Board(1.0, 0.0), DeviceClock()
    board.answer(clock, 0.0, 0.0, 0.0)
    assert error(clock, board, 0.0) == pytest.approx(0.0, abs=3e-6)
    assert clock.round_trip == pytest.approx(0.0, abs=3e-6)


def test_hours_of_silence_are_bridged():
    """Four wraps without a word: the host's clock says which one it is."""
    board, clock = Board(100.0, 50e-6), DeviceClock()
    board.answer_often(clock, np.arange(0.0, 60.0, 0.5))
    assert not board.answer(clock, 18_000.0, 1e-3, 1e-3)
    assert abs(error(clock, board, 18_000.0)) < 5e-3


def test_a_restarted_board_starts_a_new_clock():
    """The same host, another board time by 10 s: the first round trip shows it, and times are right
    again.
    """
    board, clock = Board(50.0, 1e-4), DeviceClock()
    board.answer_often(clock, np.arange(0.0, 20.0, 0.5))
    again = Board(-20.0, 1e-4)
    assert again.answer(clock, 20.5, 1e-3, 1e-3)
    assert abs(error(clock, again, 20.6)) < 1e-3
    clock.restart()
    assert not clock.is_synchronised and not again.answer(clock, 21.0, 1e-3, 1e-3)


def test_before_the_first_round_trip_nothing_is_known():
    """Not a number, and no bound."""
    clock = DeviceClock()
    assert (
        math.isnan(clock.to_host(5))
        and clock.error_bound(5) == math.inf
        and math.isnan(clock.round_trip)
    )
