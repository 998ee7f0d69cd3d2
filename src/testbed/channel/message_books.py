"""The books of the messages that a transport carries."""

from __future__ import annotations

from dataclasses import dataclass

from testbed.channel.books import Books


@dataclass
class MessageBooks(Books):
    """Counts of messages: sent = delivered + dropped + in flight. Copies are a matter of packets, not of messages.

    late: of those delivered or dropped, the ones that a newer message had overtaken. repeated: packets that came after
    their message was complete. Causes of a drop: udp "loss", "queue", "corrupt", "late"; tcp "full", "connection",
    "closed".
    """

    late: int = 0
    repeated: int = 0

    def as_counters(self) -> dict[str, int]:
        """Flat: ``dropped`` in all, and ``dropped_CAUSE`` for each cause."""
        return super().as_counters() | {"late": self.late, "repeated": self.repeated}
