"""What is on its way: items in the order of the time at which they are due."""

from __future__ import annotations

import heapq
from collections.abc import Iterator
from typing import Generic, TypeVar

T = TypeVar("T")


class Schedule(Generic[T]):
    """Items by due time in ns; those of one time in the order in which they were pushed."""

    def __init__(self) -> None:
        self._heap: list[tuple[int, int, T]] = []
        self._pushed = 0

    def __len__(self) -> int:
        return len(self._heap)

    def __iter__(self) -> Iterator[T]:
        """The items, in no order."""
        return (item for _, _, item in self._heap)

    @property
    def next_ns(self) -> int | None:
        """When the first item is due; None if there is none."""
        return self._heap[0][0] if self._heap else None

    def push(self, at_ns: int, item: T) -> None:
        heapq.heappush(self._heap, (at_ns, self._pushed, item))
        self._pushed += 1

    def due(self, now_ns: int) -> Iterator[tuple[int, T]]:
        """Take out, one by one, what is due at ``now_ns`` or before: (due time, item)."""
        heap = self._heap
        while heap and heap[0][0] <= now_ns:
            at_ns, _, item = heapq.heappop(heap)
            yield at_ns, item
