"""The controller: sends u_k as the clock allows; in a closed loop, when the estimate of k has come."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from testbed.numerics.lanes import Floats, array_of, constant, constant_times, vector_of
from testbed.plant.inputs import open_loop
from testbed.scenario import FeedbackInput
from testbed.wire.messages import ClockMessage, Control, EstimateMessage
from testbed.wire.node import ORCHESTRATOR, Node
from testbed.wire.setup import Setup

ROLE = "controller"


def build(node: Node, setup: Setup) -> OpenLoop | Feedback:
    return (
        Feedback(node, setup, setup.scenario.input)
        if isinstance(setup.scenario.input, FeedbackInput)
        else OpenLoop(node, setup)
    )


class OpenLoop:
    """Streams u_0, u_1, … up to what the clock grants."""

    def __init__(self, node: Node, setup: Setup) -> None:
        self._steps = setup.scenario.steps
        self._sources = [(lane, lanes, open_loop(setup.scenario, lane, lanes)) for lane, lanes in setup.blocks]
        self._send = node.sender(node.keys.sent("control"), Control, tap=True)
        self._next = 0
        self.counters: dict[str, int] = {}
        node.on(node.keys.clock, ClockMessage, ORCHESTRATOR, self._tick)

    def _tick(self, clock: ClockMessage, _: dict[str, NDArray[Any]]) -> None:
        for k in range(self._next, min(clock.step, self._steps)):
            for lane, lanes, source in self._sources:
                self._send(k, lane, lanes, {"u": source(k)})
            self._next = k + 1


class Feedback:
    """u_k = −L x̂_k, in lock-step; u_0 from the prior mean."""

    def __init__(self, node: Node, setup: Setup, feedback: FeedbackInput) -> None:
        self._setup = setup
        self._gain = constant(-np.array(feedback.gain))
        self._send = node.sender(node.keys.sent("control"), Control, tap=True)
        self._granted = 0
        self._ready: dict[int, tuple[int, Floats]] = {}
        for lane, lanes in setup.blocks:
            self._ready[lane] = (0, self._law(np.tile(np.array(setup.scenario.system.x0_mean), (lanes, 1))))
        self.counters: dict[str, int] = {}
        node.on(node.keys.clock, ClockMessage, ORCHESTRATOR, self._tick)
        name = feedback.estimator
        node.on(node.keys.estimate(name), EstimateMessage, _is_estimator, self._follow)

    def _law(self, x_hat: Floats) -> Floats:
        return array_of(constant_times(self._gain, vector_of(x_hat)), len(x_hat))

    def _follow(self, packet: EstimateMessage, arrays: dict[str, NDArray[Any]]) -> None:
        self._ready[packet.lane] = (packet.step, self._law(arrays["x_hat"]))
        self._send_ready()

    def _tick(self, clock: ClockMessage, _: dict[str, NDArray[Any]]) -> None:
        self._granted = min(clock.step, self._setup.scenario.steps)
        self._send_ready()

    def _send_ready(self) -> None:
        for lane, (k, u) in list(self._ready.items()):
            if k < self._granted:
                del self._ready[lane]
                self._send(k, lane, len(u), {"u": u})


def _is_estimator(packet: EstimateMessage) -> bool:
    """Which of them serves the name may change; that there is one for each step is checked by the numbers."""
    return packet.source.startswith("estimator.")


if __name__ == "__main__":
    import sys

    from testbed.wire.process import main

    sys.exit(main(None, ROLE, build, "The controller of a run."))
