"""A pipeline whose losses and delay are told, so that a timeline can be computed by hand."""

from __future__ import annotations

from collections.abc import Callable, Collection

from testbed.channel.pipeline import Copy, Pipeline
from testbed.scenario.links import Impairments

MS = 1_000_000
S = 1_000 * MS


class Scripted(Pipeline):
    """Packets take ``delay_ns``; dropped are those numbered in ``drops`` or sent when ``silent`` says so.

    log: (time, size) of each packet that was sent.
    """

    def __init__(
        self, delay_ns: int, drops: Collection[int] = (), silent: Callable[[int], bool] = lambda now_ns: False
    ) -> None:
        super().__init__(Impairments(), 1, "scripted")
        self._by_ns, self._drops, self._silent = delay_ns, drops, silent
        self.log: list[tuple[int, int]] = []

    def send(self, size: int, now_ns: int) -> tuple[Copy, ...]:
        assert not self.log or now_ns >= self.log[-1][0]
        number = len(self.log)
        self.log.append((now_ns, size))
        self.books.sent += 1
        self.cause = None
        if number in self._drops or self._silent(now_ns):
            self.cause = "loss"
            self.books.drop("loss")
            return ()
        return (Copy(now_ns + self._by_ns),)
