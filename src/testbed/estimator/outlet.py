"""Where the estimates of a service go: published, or held back until it is known whether they count."""

from __future__ import annotations

from copy import deepcopy
from typing import Any

from numpy.typing import NDArray

from testbed.wire.node import Send

Arrays = dict[str, NDArray[Any]]


class Outlet:
    """Publishes estimates; those of steps after ``held_after``, where that is set, it holds back."""

    def __init__(self, name: str, send: Send) -> None:
        self._name, self._send = name, send
        self._before: list[tuple[int, str, Send]] = []
        """Under which name the estimates up to a step go, where those behind it go under another."""
        self.held_after: int | None = None
        self._held: list[tuple[int, int, int, Arrays]] = []

    def __call__(self, step: int, lane: int, lanes: int, arrays: Arrays) -> None:
        if self.held_after is None or step <= self.held_after:
            self._way(step)[1](step, lane, lanes, arrays)
        else:
            self._held.append((step, lane, lanes, deepcopy(arrays)))  # an estimator may use its arrays again

    def name_at(self, step: int) -> str:
        """The name of the estimates of a step."""
        return self._way(step)[0]

    def turn(self, name: str, send: Send, *, after: int) -> None:
        """Let the estimates of later steps than ``after`` go under another name."""
        self._before.append((after, self._name, self._send))
        self._name, self._send = name, send

    def release(self) -> None:
        """Publish what is held back, and what comes."""
        self.held_after = None
        held, self._held = self._held, []
        for step, lane, lanes, arrays in held:
            self._way(step)[1](step, lane, lanes, arrays)

    def _way(self, step: int) -> tuple[str, Send]:
        if self._before and step <= self._before[-1][0]:
            return next((name, send) for last, name, send in self._before if step <= last)
        return self._name, self._send
