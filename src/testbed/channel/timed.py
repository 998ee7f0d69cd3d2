"""A link that takes time, for a block of lanes: from the packets sent to the arrays that it delivers, step by step."""

from __future__ import annotations

from collections import Counter
from typing import Any

import numpy as np
from numpy.typing import NDArray

from testbed.channel.books import Books
from testbed.channel.loss import LossCounts
from testbed.channel.steps import Arrivals, StepLink, SteppedLink
from testbed.errors import UsageError
from testbed.numerics.lanes import Bools
from testbed.scenario.links import Impairments
from testbed.wire.state import Unpacked

Arrays = dict[str, NDArray[Any]]

_KEEP_BYTES = 64_000_000
_KEEP_LEAST = 64
_KEEP_BESIDE = 400  # bytes that a packet takes beside its content

_UNKNOWN = np.zeros(0)


class TimedBlock:
    """Keeps what is under way, and hands it over when it arrives.

    What is kept is bounded: what comes more than ``keep`` packets late is dropped and counted as "stale".
    """

    def __init__(self, link: StepLink, lanes: int, name: str, *, first_step: int, keep: int, batch: int = 1) -> None:
        """name: of the content. first_step: step of packet 0. keep: see above, and ``room``. batch: outcomes that a
        packet carries (ACKs), less than keep."""
        self._link, self._lanes, self._name = link, lanes, name
        self._first_step, self._batch = first_step, batch
        self._contents: dict[int, NDArray[Any]] = {}
        self._known: dict[int, Bools] = {}
        self._keep = keep
        self._late = 0
        self._stale = 0
        self.counts = LossCounts()
        """Of what arrived in time."""

    @property
    def books(self) -> Books:
        """Of packets, all lanes together. What came late is delivered, what came too late for that is dropped."""
        books = self._link.books
        books.delivered -= self._stale
        books.dropped["stale"] += self._stale
        return books

    @property
    def transport(self) -> Counter[str]:
        """What the connections under it did."""
        return self._link.transport

    @property
    def late(self) -> int:
        """Packets that arrived after their deadline, and were handed over."""
        return self._late

    def change(self, settings: Impairments) -> None:
        self._link.change(settings)

    def in_time(self, number: int) -> Bools:
        """Send a packet of which only what is in time is of use; the rest is late, and not handed over."""
        arrivals = self._send(number)
        self._late += sum(int(np.count_nonzero(lanes)) for _, lanes in arrivals.late)
        return arrivals.in_time

    def pass_on(self, number: int, content: NDArray[Any]) -> Arrays:
        """Send packet ``number``, content (M, …), and what is delivered before the next: arrays of a message."""
        self._remember(number, np.array(content))
        fresh = self._fresh(number)
        mask = fresh.pop(number, np.zeros(self._lanes, dtype=np.bool_))
        out: Arrays = {"mask": mask.astype(np.uint8)}
        if mask.any():
            out = {self._name: blanked(content, mask), **out}
        return {**out, **self._late_arrays(sorted(fresh.items()))}

    def again(self, number: int) -> None:
        """What ``pass_on`` does, for a packet whose content is not known; see ``recall``."""
        self._remember(number, _UNKNOWN)
        self._fresh(number)

    @property
    def packets(self) -> int:
        """How many there were."""
        return self.counts.sent // self._lanes

    def on_the_way(self) -> Arrays:
        """By number, the contents that may still be handed over: all that fates and numbers do not say again."""
        assert isinstance(self._link, SteppedLink)
        batches = {one for n in self._link.under_way | {self.packets} for one in range(n - self._batch + 1, n + 1)}
        numbers = sorted(n for n in batches & self._contents.keys() if not self._known[n].all())
        if not numbers:
            return {}
        return {"numbers": np.array(numbers), "contents": np.array([self._contents[n] for n in numbers])}

    def recall(self, given: Unpacked) -> None:
        """Take the contents that ``on_the_way`` gave. Raises UsageError where they are none."""
        if "numbers" not in given:
            return
        numbers = given.array("numbers", np.int64, None).tolist()
        kind, shape = (np.uint8, ()) if self._name == "nu" else (np.float64, (None,))
        contents = given.array("contents", kind, len(numbers), self._lanes, *shape)
        for number, content in zip(numbers, contents, strict=True):
            if number not in self._contents:
                raise UsageError(f"state: packet {number} is not on its way")
            self._contents[number] = content

    def _fresh(self, number: int) -> dict[int, Bools]:
        """Send packet ``number``; the lanes in which it and others are known from now on."""
        arrivals = self._send(number)
        fresh: dict[int, Bools] = {}
        for packet, lanes in [*arrivals.late, (number, arrivals.in_time)]:
            if packet < number:
                if packet in self._contents:
                    self._late += int(np.count_nonzero(lanes))
                else:
                    self._stale += int(np.count_nonzero(lanes))
            for one in range(max(packet - self._batch + 1, 0), packet + 1):
                if one not in self._contents:
                    continue
                new = lanes & ~self._known[one]
                if new.any():
                    self._known[one] |= new
                    fresh[one] = fresh.get(one, np.zeros(self._lanes, dtype=np.bool_)) | new
        return fresh

    def _send(self, number: int) -> Arrivals:
        arrivals = self._link.send(number)
        self.counts.count(arrivals.in_time if self._lanes > 1 else bool(arrivals.in_time[0]))
        return arrivals

    def _late_arrays(self, late: list[tuple[int, Bools]]) -> Arrays:
        if not late:
            return {}
        steps = np.array([float(number + self._first_step) for number, _ in late])
        return {
            f"late_{self._name}": np.stack([blanked(self._contents[n], lanes) for n, lanes in late], axis=1),
            "late_mask": np.stack([lanes for _, lanes in late], axis=1).astype(np.uint8),
            "late_step": np.tile(steps, (self._lanes, 1)),
        }

    def _remember(self, number: int, content: NDArray[Any]) -> None:
        self._contents[number] = content
        self._known[number] = np.zeros(self._lanes, dtype=np.bool_)
        old = number - self._keep - 1
        self._contents.pop(old, None)
        self._known.pop(old, None)


def room(lanes: int, entry_bytes: int, batch: int) -> int:
    """Packets to keep on a link of so many lanes in all, each with so many bytes of content."""
    return max(_KEEP_LEAST, batch, _KEEP_BYTES // (lanes * entry_bytes + _KEEP_BESIDE))


def blanked(content: NDArray[Any], lanes: Bools) -> NDArray[Any]:
    """The content with zeros in the other lanes."""
    if lanes.all():
        return content
    out = np.array(content)
    out[~lanes] = 0
    return out


def timed_counters(blocks: list[TimedBlock], keeps_late: bool) -> dict[str, int]:
    """The counters of a link that takes time; nothing where there is no block."""
    total: Counter[str] = Counter()
    for block in blocks:
        books = block.books
        total["late"] += block.late
        if not keeps_late:
            books.delivered -= block.late
            books.dropped["late"] += block.late
        counts = block.counts.as_counters()
        total.update({key: counts[key] for key in ("bursts", "00", "01", "10", "11")})
        total.update(books.as_counters())
        total.update({f"transport_{key}": count for key, count in block.transport.items()})
    return dict(total)
