"""What carries whole messages over a pipeline, or a pair of them: the interface, and the books of messages."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, field
from typing import Protocol


@dataclass
class MessageBooks:
    """Counts of messages: sent = delivered + dropped + in flight.

    late: of those delivered or dropped, the ones that a newer message had overtaken. repeated: further complete copies
    of a message, of which nothing came.
    """

    sent: int = 0
    delivered: int = 0
    late: int = 0
    repeated: int = 0
    dropped: Counter[str] = field(default_factory=Counter)
    """By cause. udp: "loss", "queue", "corrupt", "late". tcp: "full", "connection", "closed"."""

    @property
    def in_flight(self) -> int:
        return self.sent - self.delivered - self.dropped.total()

    def as_counters(self) -> dict[str, int]:
        """Flat: ``dropped`` in all, and ``dropped_CAUSE`` for each cause."""
        return {
            "sent": self.sent,
            "delivered": self.delivered,
            "dropped": self.dropped.total(),
            "late": self.late,
            "repeated": self.repeated,
            "in_flight": self.in_flight,
            **{f"dropped_{cause}": count for cause, count in sorted(self.dropped.items())},
        }


class Carrier(Protocol):
    """One direction of a link for one lane, as an application sees it, in simulated time (integer ns)."""

    books: MessageBooks

    def send(self, number: int, size: int, now_ns: int) -> None:
        """A message of ``size`` bytes is handed over. Neither ``number`` nor ``now_ns`` ever decreases."""

    def advance(self, to_ns: int) -> list[tuple[int, int]]:
        """(time, number) of each message that the receiving application got up to ``to_ns``, in order of time.

        What was handed over by an earlier call is not repeated.
        """

    @property
    def next_ns(self) -> int | None:
        """When something happens next; None while nothing is on its way."""
