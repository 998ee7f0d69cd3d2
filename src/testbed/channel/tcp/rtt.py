"""Round trip times and the retransmission time-out (RFC 6298), with the constants and the variance of Linux."""

from __future__ import annotations

INITIAL_NS = 1_000_000_000
LEAST_NS = 200_000_000
GREATEST_NS = 120_000_000_000


class RoundTrips:
    """Smoothed round trip and its deviation, ns.

    RFC 6298 has RTO = SRTT + 4 RTTVAR, at least 1 s. Linux holds 4 RTTVAR itself at 200 ms or more, follows its
    increases at once and its decreases by a quarter a round trip, and lets a sudden fall of the round trip count an
    eighth of what a rise counts. So RTO is at least SRTT + 200 ms.
    """

    def __init__(self) -> None:
        self.smoothed_ns = 0
        self.least_ns: int | None = None
        self.timeout_ns = INITIAL_NS
        self._deviation = 0  # 4 mean deviations
        self._deviation_max = LEAST_NS
        self._variation = 0
        self._round_end = 0

    def see_least(self, sample_ns: int) -> None:
        """A round trip that bounds the path's from above."""
        if self.least_ns is None or sample_ns < self.least_ns:
            self.least_ns = sample_ns

    def sample(self, sample_ns: int, acknowledged: int, sent: int) -> None:
        """A round trip was measured when the stream was acknowledged and sent up to these offsets. Ends back-off."""
        if not self.smoothed_ns:
            self.smoothed_ns = max(1, sample_ns)
            self._deviation = 2 * sample_ns
            self._variation = self._deviation_max = max(self._deviation, LEAST_NS)
            self._round_end = sent
        else:
            error = sample_ns - self.smoothed_ns
            self.smoothed_ns = max(1, self.smoothed_ns + (error >> 3))
            change = abs(error) - (self._deviation >> 2)
            if error < 0 and change > 0:
                change >>= 3
            self._deviation += change
            if self._deviation > self._deviation_max:
                self._deviation_max = self._deviation
                self._variation = max(self._variation, self._deviation_max)
            if acknowledged > self._round_end:
                if self._deviation_max < self._variation:
                    self._variation -= (self._variation - self._deviation_max) >> 2
                self._round_end = sent
                self._deviation_max = LEAST_NS
        self.timeout_ns = min(self.smoothed_ns + self._variation, GREATEST_NS)

    def back_off(self) -> None:
        """A time-out: the next one takes twice as long (RFC 6298, 5.5)."""
        self.timeout_ns = min(2 * self.timeout_ns, GREATEST_NS)
