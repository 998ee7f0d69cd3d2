"""The in-process bus with faults: roles die in the middle of anything, messages wait, come twice, or are garbage."""

from __future__ import annotations

from collections import defaultdict, deque
from collections.abc import Callable, Sequence
from functools import partial

from faults.disturbances import Disturbance, Garbage, Kill, Repeat, Stall
from testbed.wire.bus import Answer, BusError, Publish
from testbed.wire.memory_bus import MemoryBus, MemoryNetwork, matches

ORCHESTRATOR = "orchestrator"


class _Died(BaseException):
    """The role whose code runs is killed at this point of it; nothing in a role may catch that."""

    def __init__(self, bus: DisturbedBus) -> None:
        self.bus = bus


class _Message:
    """One that was published; how many have it, and whether it went down with its sender."""

    def __init__(self, key: str, payload: bytes) -> None:
        self.key, self.payload, self.taken, self.lost = key, payload, 0, False


class DisturbedNetwork(MemoryNetwork):
    """``disturbances``: what happens, in order of the messages after which it does. ``killed``: the roles, in order.

    A role that dies takes down what it has published and nobody has received yet: on each key the newest so many, for
    a process sends in order on each key, and what waits in it is lost with it.
    """

    def __init__(
        self, seed: int | None = None, *, timed: bool = False, disturbances: Sequence[Disturbance] = ()
    ) -> None:
        super().__init__(seed, timed=timed)
        self.delivered, self._delivering = 0, False
        self.killed: list[str] = []
        self.log: list[str] = []
        self._coming = deque(disturbances)
        self._buses: list[DisturbedBus] = []
        self._aside: dict[DisturbedBus, int] = {}
        """Stalled receivers, with the number of the message after which they go on."""
        self._order_aside: list[MemoryBus] = []
        self._seen: dict[str, list[bytes]] = defaultdict(list)

    def bus(self) -> DisturbedBus:
        made = DisturbedBus(self)
        self._buses.append(made)
        return made

    def step(self) -> bool:
        self.delivered += 1
        while self._coming and self._coming[0].at <= self.delivered:
            self._disturb(self._coming.popleft())
        self._set_aside()
        self._delivering = True
        try:
            return super().step()
        except _Died as died:
            self.die(died.bus)
            return True
        finally:
            self._delivering = False

    def publish_from(self, bus: DisturbedBus, key: str, payload: bytes) -> None:
        if bus.dead:
            return
        if bus.steps_left == 0 and self._delivering:
            raise _Died(bus)
        if bus.steps_left:
            bus.steps_left -= 1
        if key.endswith("/command") and b'"action":"stop"' in payload:
            self._is_over()
        message = _Message(key, payload)
        bus.sent.append(message)
        seen = self._seen[key]
        seen.append(payload)
        self._send(message)

    def _is_over(self) -> None:
        """All that is left is to report; nobody is started anew for that."""
        self._coming.clear()
        for bus in self._buses:
            bus.steps_left = None

    def die(self, bus: DisturbedBus) -> None:
        """Close the bus of a role; what nobody has received of it yet may be lost."""
        if bus.dead:
            return
        kill, bus.dead, bus.steps_left = bus.kill, True, None
        assert kill is not None
        by_key: dict[str, list[_Message]] = defaultdict(list)
        for message in bus.sent:
            by_key[message.key].append(message)
        dropped = 0
        for messages in by_key.values():
            fresh = 0
            while fresh < len(messages) and not messages[-1 - fresh].taken:
                fresh += 1
            for message in messages[len(messages) - kill.lost(fresh) :]:
                message.lost = True
                dropped += 1
        self.killed.append(bus.role)
        self.log.append(f"message {self.delivered}: {bus.role} dies, {dropped} messages of it are lost")
        bus.close()

    def _send(self, message: _Message) -> None:
        for bus, handler in self._route(message.key):
            self._enqueue(bus, partial(_deliver, handler, message))

    def _route(self, key: str) -> list[tuple[MemoryBus, Callable[[str, bytes], None]]]:
        route = self._routes.get(key)
        if route is None:
            route = [(bus, handler) for pattern, bus, handler in self._subscribers if matches(pattern, key)]
            self._routes[key] = route
        return route

    def _enqueue(self, bus: MemoryBus, call: Callable[[], None]) -> None:
        if bus in self._aside:
            bus.inbox.append(call)
            self._order_aside.append(bus)
        else:
            super()._enqueue(bus, call)

    def _set_aside(self) -> None:
        """Bring back receivers whose time is over, and all of them where nobody else has anything to do."""
        back = [bus for bus, until in self._aside.items() if until <= self.delivered or bus.dead or not self._order]
        for bus in back:
            del self._aside[bus]
        if back:
            self._order.extend(bus for bus in self._order_aside if bus in back and not bus.dead)  # type: ignore[attr-defined]
            self._order_aside = [bus for bus in self._order_aside if bus not in back]

    def _disturb(self, what: Disturbance) -> None:
        if isinstance(what, Kill):
            for bus in what.victims(self._alive(), self.killed[-1] if self.killed else None):
                bus.kill, bus.steps_left = what, what.after
                if what.after is None:
                    self.die(bus)
        elif isinstance(what, Stall):
            for bus in what.victims([bus for bus in self._buses if not bus.dead], None):
                self._aside[bus] = self.delivered + what.lasts
                self._order_aside += [entry for entry in self._order if entry is bus]
                self._order = deque(entry for entry in self._order if entry is not bus)
        elif isinstance(what, Repeat):
            for key, payload in what.pick(self._seen):
                self._send(_Message(key, payload))
        elif isinstance(what, Garbage):
            for key, payload in what.made(self._seen):
                self._send(_Message(key, payload))

    def _alive(self) -> list[DisturbedBus]:
        """Those of roles that are there, in the order of joining; not the orchestrator's."""
        there = {id(bus) for bus, _ in self._tokens}
        return [
            bus
            for bus in self._buses
            if id(bus) in there and bus.role != ORCHESTRATOR and not bus.left and bus.kill is None
        ]


class DisturbedBus(MemoryBus):
    """Knows the role that it serves, what that has sent, and when it is to die."""

    def __init__(self, network: DisturbedNetwork) -> None:
        super().__init__(network)
        self._disturbed = network
        self.role = ""
        self.dead = self.left = False
        """left: as it was told to; what it has to report is said at the end of the run."""
        self.kill: Kill | None = None
        self.steps_left: int | None = None
        """Messages that it may still publish; None: any number."""
        self.sent: list[_Message] = []

    def publisher(self, key: str, *, lazy: bool = False) -> Publish:
        return partial(self._disturbed.publish_from, self, key)

    def answer(self, key: str, answer: Answer) -> None:
        super().answer(key, partial(self._answered, key, answer))

    def announce(self, key: str) -> None:
        self.role = key.rsplit("/", 1)[1]
        super().announce(key)

    def _answered(self, key: str, answer: Answer, question: bytes) -> bytes:
        try:
            told = answer(question)
            self.left = self.left or b'"action":"leave"' in question
            return told
        except _Died as died:
            self._disturbed.die(died.bus)
            raise BusError(f"nobody answers on {key}") from None


def _deliver(handler: Callable[[str, bytes], None], message: _Message) -> None:
    if not message.lost:
        message.taken += 1
        handler(message.key, message.payload)
