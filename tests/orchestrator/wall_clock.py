"""A wall clock that the test moves, and an in-process bus that runs by it: no test waits, and every date is exact."""

from __future__ import annotations

from collections.abc import Callable

from testbed.wire.memory_bus import MemoryNetwork
from testbed.wire.timers import WallClock

MS = 1_000_000
BEGUN_NS = 1_700_000_000_000_000_000


class TestClock(WallClock):
    """Time passes only in ``sleep``, which may take longer than asked for, and where a test says so."""

    __test__ = False

    def __init__(self, overshoot: Callable[[], int] = lambda: 0) -> None:
        self.now_ns, self.set_ns, self._overshoot = 5_000, BEGUN_NS, overshoot

    def monotonic_ns(self) -> int:
        return self.now_ns

    def date_ns(self) -> int:
        return self.set_ns + self.now_ns

    def sleep(self, duration_s: float) -> None:
        self.now_ns += round(duration_s * 1e9) + self._overshoot()


class Simulated(MemoryNetwork):
    """Calls ``before(key without the run, number on this key)`` ahead of each message; it may move the clock.

    Where that says False, the message is held back until ``release``.
    """

    clock: TestClock

    def __init__(self, seed: int | None = None, *, timed: bool = False) -> None:
        super().__init__(seed, timed=timed, clock=TestClock(self.overshoot))
        self.held: list[tuple[str, bytes]] = []
        self._numbers: dict[str, int] = {}

    def overshoot(self) -> int:
        return 0

    def before(self, key: str, number: int) -> bool:
        return True

    def release(self) -> None:
        held, self.held = self.held, []
        for key, payload in held:
            super()._publish(key, payload)

    def _publish(self, key: str, payload: bytes) -> None:
        short = key.split("/", 2)[2]
        number = self._numbers[short] = self._numbers.get(short, -1) + 1
        if self.before(short, number):
            super()._publish(key, payload)
        else:
            self.held.append((key, payload))
