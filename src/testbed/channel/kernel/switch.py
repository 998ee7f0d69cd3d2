"""The loop that moves packets both ways and answers the owner."""

from __future__ import annotations

import select
from collections.abc import Callable, Sequence

from testbed.channel.kernel.way import Way


def serve(ways: dict[int, Way], clock: Callable[[], int], others: dict[int, Callable[[], bool]]) -> None:
    """Until one of ``others`` says False. Both by the file descriptor to read; the ways' are their sources'.

    select, because it waits to the microsecond where epoll waits to the millisecond.
    """
    waiting: Sequence[int] = [*ways, *others]
    both = list(ways.values())
    while True:
        due = [at_ns for way in both if (at_ns := way.next_ns) is not None]
        timeout = max(0, min(due) - clock()) * 1e-9 if due else None
        for fd in select.select(waiting, (), (), timeout)[0]:
            if fd in ways:
                ways[fd].take()
            elif not others[fd]():
                return
        for way in both:
            if way.next_ns is not None:
                way.release()
