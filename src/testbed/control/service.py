"""The controller: sends u_k as the clock allows; in a closed loop, when the estimate of k has come."""

from __future__ import annotations

from typing import Any, get_args

import numpy as np
from numpy.typing import NDArray

from testbed.errors import RunFailed, UsageError
from testbed.numerics.lanes import Floats
from testbed.plant.inputs import open_loop
from testbed.scenario import ClosedLoop, Following, PythonInput
from testbed.scenario.plant_events import InputEvent
from testbed.wire.codec import all_finite
from testbed.wire.messages import Change, ClockMessage, Control, EstimateMessage
from testbed.wire.node import ORCHESTRATOR, Node
from testbed.wire.setup import Setup

ROLE = "controller"


def build(node: Node, setup: Setup) -> OpenLoopService | ClosedLoopService:
    from testbed.control.paced import PacedClosedLoop, PacedOpenLoop

    source = setup.scenario.input
    if isinstance(source, ClosedLoop):
        assert isinstance(source, get_args(Following))
        return (PacedClosedLoop if setup.real else ClosedLoopService)(node, setup, source)
    return (PacedOpenLoop if setup.real else OpenLoopService)(node, setup)


def _is_estimator(packet: EstimateMessage) -> bool:
    """Which of them serves the name may change; that there is one for each step is checked by the numbers."""
    return packet.source.startswith("estimator.")


class OpenLoopService:
    """Streams u_0, u_1, … up to what the clock grants."""

    def __init__(self, node: Node, setup: Setup) -> None:
        self._steps = setup.scenario.steps
        self._sources = [(lane, lanes, open_loop(setup.scenario, lane, lanes)) for lane, lanes in setup.blocks]
        self._send = node.sender(node.keys.sent("control"), Control, tap=True)
        self._next = 0
        self.counters: dict[str, int] = {}
        node.on(node.keys.clock, ClockMessage, ORCHESTRATOR, self._tick)
        node.on(node.keys.change(ROLE), Change, ORCHESTRATOR, self._change)

    def _change(self, change: Change, _: dict[str, NDArray[Any]]) -> None:
        """Take an order to send another input from a step on that is still to come; the orchestrator has checked it."""
        event = InputEvent.model_validate(change.set)
        for _lane, _lanes, source in self._sources:
            source.change(change.step, event.input)

    def _tick(self, clock: ClockMessage, _: dict[str, NDArray[Any]]) -> None:
        for k in range(self._next, min(clock.step, self._steps)):
            for lane, lanes, source in self._sources:
                self._send(k, lane, lanes, {"u": source(k)})
            self._next = k + 1


class ClosedLoopService:
    """u_k from x̂_k and P_k, in lock-step, within the limits; u_0 from the prior.

    ``controllers`` hold all that the next step depends on, besides what is ready to be sent.
    """

    def __init__(self, node: Node, setup: Setup, source: Following) -> None:
        from testbed.control.limits import Limits
        from testbed.control.registry import checked_step, create
        from testbed.estimator.registry import model_of

        scenario, model = setup.scenario, model_of(setup.scenario)
        self._steps, self._q = scenario.steps, model.q
        self._limits = Limits.of(source, model.q)
        self._checked = checked_step if isinstance(source, PythonInput) else None
        self.controllers = {
            lane: create(source, model, lanes=lanes, steps=scenario.steps, lane=lane) for lane, lanes in setup.blocks
        }
        self.counters: dict[str, int] = {"saturated": 0} if self._limits.given else {}
        self._send = node.sender(node.keys.sent("control"), Control, tap=True)
        self._granted = 0
        self._ready: dict[int, tuple[int, Floats]] = {}
        for lane, lanes in setup.blocks:
            self._compute(0, lane, np.tile(model.x0_mean, (lanes, 1)), np.tile(model.P0, (lanes, 1, 1)))
        node.on(node.keys.clock, ClockMessage, ORCHESTRATOR, self._tick)
        self._listen(node, source.estimator)

    def _listen(self, node: Node, name: str) -> None:
        """Follow the estimates of an estimator: the one place that says whose they are."""
        node.on(node.keys.estimate(name), EstimateMessage, _is_estimator, self._follow)

    def _follow(self, packet: EstimateMessage, arrays: dict[str, NDArray[Any]]) -> None:
        if packet.step < self._steps:
            self._compute(packet.step, packet.lane, arrays["x_hat"], arrays["P"])
            self._send_ready()

    def _compute(self, k: int, lane: int, x_hat: Floats, P: Floats) -> None:
        controller = self.controllers[lane]
        if self._checked is None:
            u = controller.step(k, x_hat, P)
        else:
            try:
                u = self._checked(controller, k, x_hat, P, self._q)
            except UsageError as error:
                raise RunFailed(str(error)) from None
        if not all_finite(u):
            raise RunFailed(f"the control left the range of floating-point numbers at step {k}")
        if self._limits.given:
            u, saturated = self._limits.held(u)
            self.counters["saturated"] += saturated
        self._ready[lane] = (k, u)

    def _tick(self, clock: ClockMessage, _: dict[str, NDArray[Any]]) -> None:
        self._granted = min(clock.step, self._steps)
        self._send_ready()

    def _send_ready(self) -> None:
        for lane, (k, u) in list(self._ready.items()):
            if k < self._granted:
                del self._ready[lane]
                self._send(k, lane, len(u), {"u": u})
