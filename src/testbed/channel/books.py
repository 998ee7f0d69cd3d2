"""The books of a link: every packet ends as delivered, dropped with a cause, or in flight."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, field


@dataclass
class Books:
    """Counts of packets and their copies: sent + duplicated = delivered + dropped + in flight.

    corrupted: copies with a bit flipped; what became of them is told by the other counts.
    """

    sent: int = 0
    duplicated: int = 0
    corrupted: int = 0
    delivered: int = 0
    dropped: Counter[str] = field(default_factory=Counter)
    """By cause: "loss", "queue", and what the receiver refuses."""

    def drop(self, cause: str) -> None:
        self.dropped[cause] += 1

    @property
    def in_flight(self) -> int:
        """Copies that are on their way."""
        return self.sent + self.duplicated - self.delivered - self.dropped.total()

    def as_counters(self) -> dict[str, int]:
        """Flat: ``dropped`` in all, and ``dropped_CAUSE`` for each cause."""
        return {
            "sent": self.sent,
            "delivered": self.delivered,
            "dropped": self.dropped.total(),
            "duplicated": self.duplicated,
            "corrupted": self.corrupted,
            "in_flight": self.in_flight,
            **{f"dropped_{cause}": count for cause, count in sorted(self.dropped.items())},
        }
