"""A link whose packets take time, seen in steps: what arrives in the step that it was sent for, and what comes late.

Packet number i = 0, 1, … is sent at i T, T the period. It is in time if it arrives within the link's deadline after
that, and late otherwise: then it belongs to the first later packet before whose deadline it arrives.
"""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from testbed.channel.books import Books
from testbed.channel.carrier import Carrier
from testbed.channel.tcp import TcpCarrier
from testbed.numerics.lanes import Bools
from testbed.scenario.links import Impairments


@dataclass(frozen=True, eq=False)
class Arrivals:
    """What arrived between the deadlines of the packet before and of this one, in M lanes.

    in_time (M,): lanes in which this packet did. late: (number of an earlier packet, lanes (M,)), by number.
    """

    in_time: Bools
    late: list[tuple[int, Bools]]


class StepLink(Protocol):
    """A link for a block of lanes, seen in steps."""

    @property
    def books(self) -> Books:
        """Of all lanes together."""
        ...

    @property
    def transport(self) -> Counter[str]:
        """What the connections under it did."""
        ...

    def send(self, number: int) -> Arrivals:
        """Send packet ``number`` in every lane, and what has arrived by its deadline."""
        ...

    def change(self, settings: Impairments) -> None:
        """Other impairments for the packets from now on."""
        ...


class SteppedLink:
    """One link for a block of lanes, a carrier a lane."""

    def __init__(self, carriers: list[Carrier], size: int, period_ns: int, deadline_ns: int) -> None:
        """size: bytes of a packet of one lane. deadline_ns: at most the period."""
        self._carriers, self._size = carriers, size
        self._period_ns, self._deadline_ns = period_ns, deadline_ns

    def send(self, number: int) -> Arrivals:
        """Send packet ``number`` in every lane, and what has arrived by its deadline."""
        now_ns = number * self._period_ns
        until_ns = now_ns + self._deadline_ns
        size = self._size
        in_time = np.zeros(len(self._carriers), dtype=np.bool_)
        late: dict[int, Bools] = {}
        for lane, carrier in enumerate(self._carriers):
            carrier.send(number, size, now_ns)
            for _, arrived in carrier.advance(until_ns):
                if arrived == number:
                    in_time[lane] = True
                else:
                    if arrived not in late:
                        late[arrived] = np.zeros(len(self._carriers), dtype=np.bool_)
                    late[arrived][lane] = True
        return Arrivals(in_time, sorted(late.items()))

    def change(self, settings: Impairments) -> None:
        """Other impairments for the packets from now on, in every lane."""
        for carrier in self._carriers:
            carrier.change(settings)

    @property
    def under_way(self) -> set[int]:
        """Packets that may still arrive in some lane."""
        return set().union(*(carrier.under_way for carrier in self._carriers))

    @property
    def transport(self) -> Counter[str]:
        """What the connections of all lanes did; nothing where there are none."""
        total: Counter[str] = Counter()
        for carrier in self._carriers:
            if isinstance(carrier, TcpCarrier):
                total.update(carrier.as_counters())
        return total

    @property
    def books(self) -> Books:
        """Of all lanes together."""
        total = Books()
        for carrier in self._carriers:
            books = carrier.books
            total.sent += books.sent
            total.duplicated += books.duplicated
            total.corrupted += books.corrupted
            total.delivered += books.delivered
            total.dropped.update(books.dropped)
        return total
