"""The controller in real time: u_k leaves when it is due on the wall clock, whatever has come until then."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from testbed.control.service import ClosedLoopService, OpenLoopService
from testbed.numerics.lanes import Floats
from testbed.scenario import Following
from testbed.wire.messages import ClockMessage, EstimateMessage
from testbed.wire.node import Node
from testbed.wire.setup import Setup
from testbed.wire.state import Unpacked


class Pace:
    """Calls ``act(k)`` for k = 0, 1, … when start + k periods has come, as far as the clock has granted steps.

    Each time is reckoned from the start, so that no delay adds to the next; what is overdue follows at once, and none
    is left out. The date of the start is turned into monotonic time once: setting the date does not touch the pace.
    """

    def __init__(self, node: Node, setup: Setup, act: Callable[[int], None]) -> None:
        self._bus, self._act = node.bus, act
        self._period_ns, self._steps = setup.scenario.clock.period_ns, setup.scenario.steps
        self._start_ns: int | None = None
        self._granted = self._next = 0
        self._waiting = False

    def grant(self, clock: ClockMessage) -> None:
        """Take what the orchestrator says of the clock."""
        if self._start_ns is None and clock.start_ns is not None:
            self._start_ns = self._bus.clock.monotonic_of(clock.start_ns)
        self._granted = min(clock.step, self._steps)
        self._wait()

    def begin_at(self, step: int) -> None:
        """The next step is ``step``."""
        self._next = step

    def _wait(self) -> None:
        if self._start_ns is not None and not self._waiting and self._next < self._granted:
            self._waiting = True
            self._bus.at(self._start_ns + self._next * self._period_ns, self._now)

    def _now(self) -> None:
        self._waiting = False
        k, self._next = self._next, self._next + 1
        self._act(k)
        self._wait()


class PacedOpenLoop(OpenLoopService):
    """Sends the input of the scenario in time."""

    def __init__(self, node: Node, setup: Setup) -> None:
        self._pace = Pace(node, setup, self._act)
        super().__init__(node, setup)

    def _tick(self, clock: ClockMessage, _: dict[str, NDArray[Any]]) -> None:
        self._pace.grant(clock)

    def resume(self, lane: int, step: int, state: bytes) -> None:
        super().resume(lane, step, state)
        self._pace.begin_at(step)


class PacedClosedLoop(ClosedLoopService):
    """u_k from the newest estimate that has come when u_k is due: that of k where it was in time; u_0 from the prior.

    The controller makes each step once, for k, and is given the older estimate as it is. Counters: ``held`` packets
    sent with an estimate older than that of k, ``held_steps`` the largest age.
    """

    def __init__(self, node: Node, setup: Setup, source: Following) -> None:
        self._pace = Pace(node, setup, self._act)
        system = setup.scenario.system
        self._n = system.n
        mean, covariance = np.array(system.x0_mean), np.array(system.P0)
        self._newest: dict[int, tuple[int, Floats, Floats]] = {
            lane: (0, np.tile(mean, (lanes, 1)), np.tile(covariance, (lanes, 1, 1))) for lane, lanes in setup.blocks
        }
        self._held, self._held_steps = ({lane: 0 for lane, _ in setup.blocks} for _ in range(2))
        super().__init__(node, setup, source)

    @property
    def counters(self) -> dict[str, int]:
        held = {"held": sum(self._held.values()), "held_steps": max(self._held_steps.values())}
        return {**super().counters, **held}

    def _given(self, lane: int) -> tuple[dict[str, NDArray[Any]], dict[str, int]]:
        """After step s: what it knew when u_{s−1} was sent."""
        arrays, numbers = super()._given(lane)
        newest, x_hat, P = self._newest[lane]
        held = {"held": self._held[lane], "held_steps": self._held_steps[lane]}
        return {**arrays, "x_hat": x_hat, "P": P}, {**numbers, "newest": newest, **held}

    def _resume(self, lane: int, step: int, given: Unpacked) -> None:
        super()._resume(lane, step, given)
        n, lanes = self._n, self._lanes[lane]
        x_hat, P = given.array("x_hat", np.float64, lanes, n), given.array("P", np.float64, lanes, n, n)
        self._newest[lane] = given.number("newest"), x_hat, P
        self._held[lane], self._held_steps[lane] = given.number("held"), given.number("held_steps")
        self._pace.begin_at(step)

    def _tick(self, clock: ClockMessage, _: dict[str, NDArray[Any]]) -> None:
        self._pace.grant(clock)

    def _follow(self, packet: EstimateMessage, arrays: dict[str, NDArray[Any]]) -> None:
        self._newest[packet.lane] = packet.step, arrays["x_hat"], arrays["P"]

    def _act(self, k: int) -> None:
        self._granted = k + 1
        for lane, (step, x_hat, P) in self._newest.items():
            if k > 0:
                self._compute(k, lane, x_hat, P)
            self._held[lane] += step < k
            self._held_steps[lane] = max(self._held_steps[lane], k - step)
            self._done[lane] = k + 1
        self._send_ready()
        for lane in self._newest:
            self._node.done(k + 1, lane)
