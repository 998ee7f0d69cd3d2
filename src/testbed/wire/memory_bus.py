"""The bus without a network: every role in one process, under a deterministic scheduler."""

from __future__ import annotations

import random
from collections import deque
from collections.abc import Callable
from functools import partial

from testbed.wire.bus import Answer, BusError, Handler, PresenceHandler, Publish


class MemoryNetwork:
    """Delivers messages one at a time: in the order of publication, or, with a seed, interleaved at random over the
    receivers while each receiver still gets its own in order (what a real network may do).
    """

    def __init__(self, seed: int | None = None) -> None:
        self._random = None if seed is None else random.Random(seed)
        self._order: deque[MemoryBus] = deque()
        self._subscribers: list[tuple[str, MemoryBus, Handler]] = []
        self._routes: dict[str, list[tuple[MemoryBus, Handler]]] = {}
        self._answers: dict[str, tuple[MemoryBus, Answer]] = {}
        self._tokens: list[tuple[MemoryBus, str]] = []
        self._watchers: list[tuple[str, MemoryBus, PresenceHandler]] = []

    def bus(self) -> MemoryBus:
        """A new participant."""
        return MemoryBus(self)

    def step(self) -> bool:
        """Deliver one message; False if none is waiting."""
        if not self._order:
            return False
        if self._random is not None:
            self._order.rotate(self._random.randrange(len(self._order)))
        self._order.popleft().deliver_one()
        return True

    def run(self, until: Callable[[], bool]) -> bool:
        """Deliver until ``until()`` is true; False if the messages ran out before."""
        while not until():
            if not self.step():
                return False
        return True

    def _enqueue(self, bus: MemoryBus, call: Callable[[], None]) -> None:
        bus.inbox.append(call)
        self._order.append(bus)

    def _publish(self, key: str, payload: bytes) -> None:
        route = self._routes.get(key)
        if route is None:
            route = [(bus, handler) for pattern, bus, handler in self._subscribers if matches(pattern, key)]
            self._routes[key] = route
        for bus, handler in route:
            self._enqueue(bus, partial(handler, key, payload))

    def _subscribe(self, key: str, bus: MemoryBus, handler: Handler) -> None:
        self._subscribers.append((key, bus, handler))
        self._routes.clear()

    def _tell(self, key: str, alive: bool) -> None:
        for pattern, bus, handler in self._watchers:
            if matches(pattern, key):
                self._enqueue(bus, partial(handler, key, alive))

    def _leave(self, leaving: MemoryBus) -> None:
        self._subscribers = [s for s in self._subscribers if s[1] is not leaving]
        self._watchers = [w for w in self._watchers if w[1] is not leaving]
        self._answers = {key: answer for key, answer in self._answers.items() if answer[0] is not leaving}
        self._routes.clear()
        self._order = deque(bus for bus in self._order if bus is not leaving)
        gone = [key for bus, key in self._tokens if bus is leaving]
        self._tokens = [token for token in self._tokens if token[0] is not leaving]
        for key in gone:
            self._tell(key, False)


class MemoryBus:
    """One participant of a MemoryNetwork."""

    def __init__(self, network: MemoryNetwork) -> None:
        self._network = network
        self.inbox: deque[Callable[[], None]] = deque()

    def deliver_one(self) -> None:
        self.inbox.popleft()()

    def publisher(self, key: str, *, lazy: bool = False) -> Publish:
        return partial(self._network._publish, key)

    def subscribe(self, key: str, handler: Handler) -> None:
        self._network._subscribe(key, self, handler)

    def ask(self, key: str, question: bytes = b"") -> bytes:
        answer = self._network._answers.get(key)
        if answer is None:
            raise BusError(f"nobody answers on {key}")
        return answer[1](question)

    def answer(self, key: str, answer: Answer) -> None:
        self._network._answers[key] = (self, answer)

    def announce(self, key: str) -> None:
        self._network._tokens.append((self, key))
        self._network._tell(key, True)

    def watch(self, key: str, handler: PresenceHandler) -> None:
        self._network._watchers.append((key, self, handler))
        for _, token in self._network._tokens:
            if matches(key, token):
                self._network._enqueue(self, partial(handler, token, True))

    def call(self, order: Callable[[], None]) -> None:
        self._network._enqueue(self, order)

    def close(self) -> None:
        self.inbox.clear()
        self._network._leave(self)


def matches(pattern: str, key: str) -> bool:
    """Whether a key matches an expression in which ``*`` stands for one part."""
    parts, names = pattern.split("/"), key.split("/")
    return len(parts) == len(names) and all(p in ("*", n) for p, n in zip(parts, names, strict=True))
