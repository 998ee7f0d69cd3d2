"""The controller in real time: u_k leaves when it is due on the wall clock, whatever has come until then."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from testbed.numerics.lanes import Floats, array_of, constant, constant_times, vector_of
from testbed.plant.inputs import open_loop
from testbed.scenario import FeedbackInput
from testbed.wire.messages import ClockMessage, Control, EstimateMessage
from testbed.wire.node import ORCHESTRATOR, Node
from testbed.wire.setup import Setup


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
        node.on(node.keys.clock, ClockMessage, ORCHESTRATOR, self._grant)

    def _grant(self, clock: ClockMessage, _: dict[str, NDArray[Any]]) -> None:
        if self._start_ns is None and clock.start_ns is not None:
            self._start_ns = self._bus.clock.monotonic_of(clock.start_ns)
        self._granted = min(clock.step, self._steps)
        self._wait()

    def _wait(self) -> None:
        if self._start_ns is not None and not self._waiting and self._next < self._granted:
            self._waiting = True
            self._bus.at(self._start_ns + self._next * self._period_ns, self._now)

    def _now(self) -> None:
        self._waiting = False
        k, self._next = self._next, self._next + 1
        self._act(k)
        self._wait()


class PacedOpenLoop:
    """Sends the input of the scenario in time."""

    def __init__(self, node: Node, setup: Setup) -> None:
        self._sources = [(lane, lanes, open_loop(setup.scenario, lane, lanes)) for lane, lanes in setup.blocks]
        self._send = node.sender(node.keys.sent("control"), Control, tap=True)
        self.counters: dict[str, int] = {}
        Pace(node, setup, self._act)

    def _act(self, k: int) -> None:
        for lane, lanes, source in self._sources:
            self._send(k, lane, lanes, {"u": source(k)})


class PacedFeedback:
    """u_k = −L x̂_j, x̂_j the newest estimate that has come when u_k is due: x̂_k where it was in time.

    Until the first has come it is the prior mean. Counters: ``held`` packets sent with j < k, ``held_steps`` the
    largest k − j.
    """

    def __init__(self, node: Node, setup: Setup, feedback: FeedbackInput) -> None:
        self._gain = constant(-np.array(feedback.gain))
        self._send = node.sender(node.keys.sent("control"), Control, tap=True)
        prior = np.array(setup.scenario.system.x0_mean)
        self._newest = {lane: (0, self._law(np.tile(prior, (lanes, 1)))) for lane, lanes in setup.blocks}
        self.counters: dict[str, int] = {"held": 0, "held_steps": 0}
        name = feedback.estimator
        node.on(node.keys.estimate(name), EstimateMessage, f"estimator.{name}", self._follow)
        Pace(node, setup, self._act)

    def _law(self, x_hat: Floats) -> Floats:
        return array_of(constant_times(self._gain, vector_of(x_hat)), len(x_hat))

    def _follow(self, packet: EstimateMessage, arrays: dict[str, NDArray[Any]]) -> None:
        self._newest[packet.lane] = (packet.step, self._law(arrays["x_hat"]))

    def _act(self, k: int) -> None:
        for lane, (step, u) in self._newest.items():
            self._send(k, lane, len(u), {"u": u})
            self.counters["held"] += step < k
            self.counters["held_steps"] = max(self.counters["held_steps"], k - step)
