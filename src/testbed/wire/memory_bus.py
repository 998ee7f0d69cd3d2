"""The bus without a network: every role in one process, under a deterministic scheduler."""

from __future__ import annotations

import random
from collections import deque
from collections.abc import Callable
from functools import partial

from testbed.wire.bus import Answer, BusError, Handler, PresenceHandler, Publish
from testbed.wire.timers import Timers, WallClock

_SLEEP_MAX_S = 0.1  # so that who steps the network can look around


class MemoryNetwork:
    """Delivers messages one at a time: in the order of publication, or, with a seed, interleaved at random over the
    receivers while each receiver still gets its own in order (what a real network may do).

    timed: messages carry when they were published. Calls that are due come before messages; where no message waits, the
    network sleeps until the next call is due.
    """

    def __init__(self, seed: int | None = None, *, timed: bool = False, clock: WallClock | None = None) -> None:
        self.clock, self.timed = clock or WallClock(), timed
        self.timers = Timers(self.clock)
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
        """Deliver one message, or make the calls that are due; False if there is nothing to wait for."""
        if self.timers.fire():
            return True
        if not self._order:
            wait_s = self.timers.wait_s
            if wait_s == float("inf"):
                return False
            self.clock.sleep(min(wait_s, _SLEEP_MAX_S))
            return True
        if self._random is not None:
            self._order.rotate(self._random.randrange(len(self._order)))
        bus = self._order.popleft()
        if bus.paused:
            bus.withheld += 1
        else:
            bus.deliver_one()
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
        if self.timed:
            date_ns = self.clock.date_ns()
            for bus, handler in route:
                self._enqueue(bus, partial(bus.take_timed, handler, key, payload, date_ns))
            return
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
        self.paused, self.withheld = False, 0
        """Whether it gets no messages for a while, and how many of those that wait for it had their turn."""
        self.published_ns = self.arrived_ns = 0

    @property
    def clock(self) -> WallClock:
        return self._network.clock

    def at(self, due_ns: int, call: Callable[[], None]) -> None:
        self._network.timers.at(due_ns, call)

    def take_timed(self, handler: Handler, key: str, payload: bytes, published_ns: int) -> None:
        self.published_ns, self.arrived_ns = published_ns, self.clock.date_ns()
        handler(key, payload)

    def pause(self, for_s: float) -> None:
        """Let no message come here for so many seconds; none is lost."""
        self.paused = True
        self.at(self.clock.monotonic_ns() + round(1e9 * for_s), self._go_on)

    def _go_on(self) -> None:
        self.paused = False
        self._network._order.extend([self] * self.withheld)
        self.withheld = 0

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
