"""Clock: SYNC round trips in, device time on the host's clock out, with a bound on its error.

A round trip has four times: the host sends, the board receives, the board replies, the host reads.
The board's two lie somewhere between the host's two, so their middles belong together within half
of the time spent on the way (Cristian, "Probabilistic clock synchronization", 1989; the same four
times as in NTP: RFC 5905, section 8). Fast round trips leave little room for error: of each eight
the fastest is kept (RFC 5905, section 10), and a line through those kept gives offset and drift.
"""

import math
from dataclasses import dataclass

import numpy as np

WRAP_US = 2**32  # device time starts again after 71.6 minutes
BYTE_S = 10 / 115200  # one byte on the wire: start, eight bits, stop
SYNC_BYTES, REPLY_BYTES = 9, 17  # frames with COBS, checksum and zero byte
GROUP, GROUPS = 8, 60  # round trips in a group, of which the fastest is kept, and groups remembered
MAX_DRIFT = 0.01  # a Mega runs on a ceramic resonator, good to 0.5 %
# a round trip that contradicts the others by more shows another clock: the board was restarted
STEP_S = 0.05


@dataclass(frozen=True)
class RoundTrip:
    """One answer of the board: at `device` it was `host`, give or take `half_width`."""

    device: float  # device time, wraps undone [s]
    host: float  # [s]
    half_width: float  # half of the time on the way [s]


class DeviceClock:
    """Where the board's microseconds lie on the host's clock: host = host_0 + rate (device -
    device_0).

    The line is fitted by least squares, each round trip weighted by its half width, with rate 1 +-
    0.5 % known before.
    """

    def __init__(self) -> None:
        self.restart()

    def restart(self) -> None:
        """Forget everything, for the board's time starts again."""
        self._best: list[RoundTrip] = []  # the fastest of each group, the newest group last
        self._in_group = 0
        self._newest: RoundTrip | None = None
        self._zero = (0.0, 0.0)  # device and host [s] of the line's middle
        self.rate = 1.0  # host seconds for a device second

    @property
    def is_synchronised(self) -> bool:
        """Has a round trip been seen?"""
        return self._newest is not None

    @property
    def drift_ppm(self) -> float:
        """How much faster than the host's the board's clock runs [1e-6]."""
        return 1e6 * (1.0 / self.rate - 1.0)

    @property
    def round_trip(self) -> float:
        """Time on the way of the newest round trip, bytes on the wire left out [s]; nan before the
        first.
        """
        return 2.0 * self._newest.half_width if self._newest else math.nan

    def add(self, sent: float, received_us: int, replied_us: int, read: float) -> bool:
        """Take in one round trip.

        Args:
            sent: when the host began to write its SYNC [s].
            received_us: device time when its last byte was read [us, 32 bits].
            replied_us: device time when the reply was queued [us, 32 bits].
            read: when the host had the reply's last byte [s].

        Returns:
            True where it contradicts the earlier ones, which are forgotten then: the board was
                restarted.
        """
        # What the bytes need on the wire is known; it would count as an asymmetry of 0.35 ms.
        begin, end = sent + SYNC_BYTES * BYTE_S, read - REPLY_BYTES * BYTE_S
        inside = _difference_us(replied_us, received_us) * 1e-6
        host = 0.5 * (begin + end)
        half_width = max(0.5 * (end - begin - inside), 0.0) + 1e-6  # us are whole
        trip = RoundTrip(self._unwrap(received_us, host) + 0.5 * inside, host, half_width)
        stepped = False
        if self._newest is not None:
            miss = abs(trip.host - self._line_at(trip.device))
            stepped = miss > trip.half_width + self._error_at(trip.device) + STEP_S
        if stepped:
            self.restart()
            trip = RoundTrip(received_us * 1e-6 + 0.5 * inside, host, half_width)
        self._keep_fastest(trip)
        self._fit()
        return stepped

    def to_host(self, device_us: int) -> float:
        """Host time of a device time.

        Args:
            device_us: 32 bits [us]; the one within 35 minutes of the newest round trip is meant.

        Returns:
            Host time [s]; nan before the first round trip.
        """
        return (
            math.nan
            if self._newest is None
            else self._line_at(self._nearest_time(device_us, self._newest.device))
        )

    def error_bound(self, device_us: int) -> float:
        """What `to_host` may be wrong by at most [s], if the board's clock is within 1 % and
        steady; inf before the first round trip.

        From each round trip the error grows with the time since then by what the drift may be
        wrong.
        """
        return (
            math.inf
            if self._newest is None
            else self._error_at(self._nearest_time(device_us, self._newest.device))
        )

    def _keep_fastest(self, trip: RoundTrip) -> None:
        """The fastest of every eight."""
        self._newest = trip
        if self._in_group == 0:
            self._best = [*self._best, trip][-GROUPS:]
        elif trip.half_width < self._best[-1].half_width:
            self._best[-1] = trip
        self._in_group = (self._in_group + 1) % GROUP

    def _fit(self) -> None:
        """Weighted least squares for offset and drift, in closed form about the weighted middle."""
        device, host, half = np.array([(b.device, b.host, b.half_width) for b in self._best]).T
        weight = half**-2
        device_0, host_0 = np.average(device, weights=weight), np.average(host, weights=weight)
        x, y = device - device_0, (host - host_0) - (device - device_0)
        known_before = (0.5 * MAX_DRIFT) ** -2
        self.rate = 1.0 + float(np.sum(weight * x * y) / (np.sum(weight * x * x) + known_before))
        self._zero = (float(device_0), float(host_0))

    def _line_at(self, device: float) -> float:
        return self._zero[1] + self.rate * (device - self._zero[0])

    def _error_at(self, device: float) -> float:
        """The best of what each round trip allows: its own half width, its distance from the line,
        the drift since.
        """
        first, last = self._best[0], self._best[-1]
        span, rate_error = last.device - first.device, 2.0 * MAX_DRIFT
        if span > 0.0:
            between = (last.host - first.host) / span
            rate_error = min(
                rate_error, abs(self.rate - between) + (first.half_width + last.half_width) / span
            )
        return min(
            b.half_width
            + abs(b.host - self._line_at(b.device))
            + rate_error * abs(device - b.device)
            for b in self._best
        )

    def _unwrap(self, device_us: int, host: float) -> float:
        """Device time without wraps [s]: the one nearest to what the line says for this host time."""
        if self._newest is None:
            return device_us * 1e-6
        return self._nearest_time(device_us, self._zero[0] + (host - self._zero[1]) / self.rate)

    @staticmethod
    def _nearest_time(device_us: int, expected: float) -> float:
        """The device time [s] nearest to the expected one of all that end in these 32 bits."""
        expected_us = round(expected * 1e6)
        return (expected_us + _difference_us(device_us, expected_us)) * 1e-6


def _difference_us(later_us: int, earlier_us: int) -> int:
    """The difference of two times of 32 bits, between -2^31 and 2^31 [us]."""
    return (later_us - earlier_us + WRAP_US // 2) % WRAP_US - WRAP_US // 2
