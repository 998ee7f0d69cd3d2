"""Where the estimates of a service go: published, or held back until it is known whether they count."""

from __future__ import annotations

from copy import deepcopy
from typing import Any

from numpy.typing import NDArray

from testbed.wire.node import Send

Arrays = dict[str, NDArray[Any]]


class Outlet:
    """Publishes estimates; those of steps after ``held_after``, where that is set, it holds back."""

    def __init__(self, send: Send) -> None:
        self._send = send
        self.held_after: int | None = None
        self._held: list[tuple[int, int, int, Arrays]] = []

    def __call__(self, step: int, lane: int, lanes: int, arrays: Arrays) -> None:
        if self.held_after is None or step <= self.held_after:
            self._send(step, lane, lanes, arrays)
        else:
            self._held.append((step, lane, lanes, deepcopy(arrays)))  # an estimator may use its arrays again

    def release(self, send: Send | None = None) -> None:
        """Publish what is held back, and what comes; ``send``: in another way."""
        self._send, self.held_after = send or self._send, None
        held, self._held = self._held, []
        for step, lane, lanes, arrays in held:
            self._send(step, lane, lanes, arrays)
