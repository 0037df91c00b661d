"""Clock synchronisation: SYNC round trips -> device time on the host's clock, with an error bound.

A round trip has four times: the host sends, the board receives, the board replies, the host reads.
The midpoints of the board's two and of the host's two are simultaneous within half of the time on
the way (Cristian, "Probabilistic clock synchronization", 1989; the four times of NTP: RFC 5905,
section 8). Fast round trips have the smallest error: of each eight the fastest is kept (RFC 5905,
section 10), and a line through those gives offset and drift.
"""

import math
from dataclasses import dataclass

import numpy as np

WRAP_US = 2**32  # device time wraps after 71.6 minutes
BYTE_S = 10 / 115200  # one byte on the wire: start, eight bits, stop
SYNC_BYTES, REPLY_BYTES = 9, 17  # frames with COBS, checksum and zero byte
GROUP, GROUPS = 8, 60  # round trips per group, of which the fastest is kept; groups kept
MAX_DRIFT = 0.01  # a Mega has a ceramic resonator with a tolerance of 0.5 %
RESTART_S = 0.05  # a larger contradiction to the earlier round trips: the board was restarted


@dataclass(frozen=True)
class RoundTrip:
    """One reply of the board: `device` is simultaneous with `host` +- `half_width`."""

    device: float  # unwrapped device time [s]
    host: float  # [s]
    half_width: float  # half of the time on the way [s]


class DeviceClock:
    """The board's microseconds on the host's clock: host = host_0 + rate (device - device_0).

    Weighted least squares over the round trips (sigma: half width), with prior rate 1 +- 0.5 %.
    """

    def __init__(self) -> None:
        self.restart()

    def restart(self) -> None:
        """Discard all round trips: the board's time starts again."""
        self._best: list[RoundTrip] = []  # the fastest of each group, the newest group last
        self._in_group = 0
        self._newest: RoundTrip | None = None
        self._zero = (0.0, 0.0)  # device_0 and host_0 [s], on the line
        self.rate = 1.0  # host seconds per device second

    @property
    def is_synchronised(self) -> bool:
        """Whether there was a round trip."""
        return self._newest is not None

    @property
    def drift_ppm(self) -> float:
        """Frequency error of the board's clock relative to the host's [1e-6], positive if fast."""
        return 1e6 * (1.0 / self.rate - 1.0)

    @property
    def round_trip(self) -> float:
        """Latency of the newest round trip without bytes on the wire [s]; nan before the first."""
        return 2.0 * self._newest.half_width if self._newest else math.nan

    def add(self, sent: float, received_us: int, replied_us: int, read: float) -> bool:
        """Add one round trip; True if the board was restarted, so earlier ones are discarded.

        Args:
            sent: host time at the first byte of its SYNC [s].
            received_us: device time at the last byte of the SYNC [us, 32 bits].
            replied_us: device time at which the reply was queued [us, 32 bits].
            read: host time at the last byte of the reply [s].
        """
        # The time of the bytes on the wire is known; uncorrected it is an asymmetry of 0.35 ms.
        begin, end = sent + SYNC_BYTES * BYTE_S, read - REPLY_BYTES * BYTE_S
        inside = _difference_us(replied_us, received_us) * 1e-6
        host = 0.5 * (begin + end)
        half_width = max(0.5 * (end - begin - inside), 0.0) + 1e-6  # resolution: 1 us
        trip = RoundTrip(self._unwrap(received_us, host) + 0.5 * inside, host, half_width)
        restarted = False
        if self._newest is not None:
            residual = abs(trip.host - self._line_at(trip.device))
            restarted = residual > trip.half_width + self._error_at(trip.device) + RESTART_S
        if restarted:
            self.restart()
            trip = RoundTrip(received_us * 1e-6 + 0.5 * inside, host, half_width)
        self._keep_fastest(trip)
        self._fit()
        return restarted

    def to_host(self, device_us: int) -> float:
        """Host time [s] of a device time [us, 32 bits]; nan before the first round trip.

        The device time is taken within 35 minutes of the newest round trip.
        """
        if self._newest is None:
            return math.nan
        return self._line_at(self._nearest_time(device_us, self._newest.device))

    def error_bound(self, device_us: int) -> float:
        """Maximum error of `to_host` [s]; inf before the first round trip.

        Valid for a board clock of constant frequency within 1 %. The error from each round trip
        grows with its age times the uncertainty of the drift.
        """
        if self._newest is None:
            return math.inf
        return self._error_at(self._nearest_time(device_us, self._newest.device))

    def _keep_fastest(self, trip: RoundTrip) -> None:
        """Keep the fastest round trip of each group."""
        self._newest = trip
        if self._in_group == 0:
            self._best = [*self._best, trip][-GROUPS:]
        elif trip.half_width < self._best[-1].half_width:
            self._best[-1] = trip
        self._in_group = (self._in_group + 1) % GROUP

    def _fit(self) -> None:
        """Weighted least squares for offset and rate, in closed form about the weighted mean."""
        device, host, half = np.array([(b.device, b.host, b.half_width) for b in self._best]).T
        weight = half**-2
        device_0, host_0 = np.average(device, weights=weight), np.average(host, weights=weight)
        # Slope of y = (rate - 1) x with a Gaussian prior on it (ridge regression).
        x, y = device - device_0, (host - host_0) - (device - device_0)
        prior_weight = (0.5 * MAX_DRIFT) ** -2
        self.rate = 1.0 + float(np.sum(weight * x * y) / (np.sum(weight * x * x) + prior_weight))
        self._zero = (float(device_0), float(host_0))

    def _line_at(self, device: float) -> float:
        """The fitted line: unwrapped device time [s] -> host time [s]."""
        return self._zero[1] + self.rate * (device - self._zero[0])

    def _error_at(self, device: float) -> float:
        """Minimum over the round trips of half width + residual + drift since then [s]."""
        first, last = self._best[0], self._best[-1]
        span, rate_error = last.device - first.device, 2.0 * MAX_DRIFT
        if span > 0.0:
            secant = (last.host - first.host) / span  # its error: both half widths over the span
            rate_error = min(
                rate_error, abs(self.rate - secant) + (first.half_width + last.half_width) / span
            )
        return min(
            b.half_width
            + abs(b.host - self._line_at(b.device))
            + rate_error * abs(device - b.device)
            for b in self._best
        )

    def _unwrap(self, device_us: int, host: float) -> float:
        """Unwrapped device time [s], nearest to the line at this host time."""
        if self._newest is None:
            return device_us * 1e-6
        return self._nearest_time(device_us, self._zero[0] + (host - self._zero[1]) / self.rate)

    @staticmethod
    def _nearest_time(device_us: int, expected: float) -> float:
        """The device time [s] with these low 32 bits that is nearest to the expected one."""
        expected_us = round(expected * 1e6)
        return (expected_us + _difference_us(device_us, expected_us)) * 1e-6


def _difference_us(later_us: int, earlier_us: int) -> int:
    """Difference of two 32-bit times, between -2^31 and 2^31 [us]."""
    return (later_us - earlier_us + WRAP_US // 2) % WRAP_US - WRAP_US // 2
