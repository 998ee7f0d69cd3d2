"""The controller: sends u_k as the clock allows; in a closed loop, when the estimate of k has come."""

from __future__ import annotations

from collections import deque
from typing import Any, get_args

import numpy as np
from numpy.typing import NDArray

from testbed.control.controller import RestartableController
from testbed.errors import RunFailed, UsageError
from testbed.numerics.lanes import Floats
from testbed.plant.inputs import open_loop
from testbed.scenario import ClosedLoop, Following, PythonInput
from testbed.scenario.plant_events import InputEvent
from testbed.wire.codec import all_finite
from testbed.wire.messages import Change, ClockMessage, Control, EstimateMessage
from testbed.wire.node import ORCHESTRATOR, Node
from testbed.wire.setup import Setup
from testbed.wire.state import Unpacked, pack, unpack

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
        self._node, self._steps = node, setup.scenario.steps
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

    @property
    def gives_state(self) -> bool:
        return True

    def state(self, lane: int) -> bytes:
        """Nothing but the step: u_k depends on k alone."""
        return pack({}, step=self._next)

    def resume(self, lane: int, step: int, state: bytes) -> None:
        """Raises UsageError for what is no state after so many steps."""
        given = unpack(state)
        given.expect(step=step)
        given.end()
        self._next = step

    def _tick(self, clock: ClockMessage, _: dict[str, NDArray[Any]]) -> None:
        for k in range(self._next, min(clock.step, self._steps)):
            self._act(k)

    def _act(self, k: int) -> None:
        for lane, lanes, source in self._sources:
            self._send(k, lane, lanes, {"u": source(k)})
        self._next = k + 1
        for lane, _, _ in self._sources:
            self._node.done(k + 1, lane)


class ClosedLoopService:
    """u_k from x̂_k and P_k, in lock-step, within the limits; u_0 from the prior.

    ``controllers`` hold all that the next step depends on, besides what is ready to be sent: more
    than u_k where it begins late, and hears of the estimates before it hears of the clock.
    """

    def __init__(self, node: Node, setup: Setup, source: Following) -> None:
        from testbed.control.limits import Limits
        from testbed.control.registry import checked_step, create
        from testbed.estimator.registry import model_of

        scenario, model = setup.scenario, model_of(setup.scenario)
        self._node, self._lanes = node, dict(setup.blocks)
        self._steps, self._q = scenario.steps, model.q
        self._limits = Limits.of(source, model.q)
        self._checked = checked_step if isinstance(source, PythonInput) else None
        self.controllers = {
            lane: create(source, model, lanes=lanes, steps=scenario.steps, lane=lane) for lane, lanes in setup.blocks
        }
        self._saturated = {lane: 0 for lane, _ in setup.blocks}
        self._done = {lane: 0 for lane, _ in setup.blocks}
        self._send = node.sender(node.keys.sent("control"), Control, tap=True)
        self._granted = 0
        self._ready: dict[int, deque[tuple[int, Floats]]] = {lane: deque() for lane, _ in setup.blocks}
        for lane, lanes in setup.blocks:
            self._compute(0, lane, np.tile(model.x0_mean, (lanes, 1)), np.tile(model.P0, (lanes, 1, 1)))
        node.on(node.keys.clock, ClockMessage, ORCHESTRATOR, self._tick)
        self._listen(node, source.estimator)

    @property
    def counters(self) -> dict[str, int]:
        return {"saturated": sum(self._saturated.values())} if self._limits.given else {}

    @property
    def gives_state(self) -> bool:
        return all(isinstance(controller, RestartableController) for controller in self.controllers.values())

    def state(self, lane: int) -> bytes:
        """After step s: the controller, and u_s, which is not sent."""
        arrays, numbers = self._given(lane)
        return pack(arrays, step=self._done[lane], **numbers)

    def _given(self, lane: int) -> tuple[dict[str, NDArray[Any]], dict[str, int]]:
        controller = self.controllers[lane]
        assert isinstance(controller, RestartableController)
        arrays = {f"controller.{name}": array for name, array in controller.state().items()}
        if self._ready[lane]:
            arrays["ready"] = self._ready[lane][-1][1]
        return arrays, {"version": controller.STATE_VERSION, "saturated": self._saturated[lane]}

    def resume(self, lane: int, step: int, state: bytes) -> None:
        """Raises UsageError for what is no state of this controller after so many steps."""
        given = unpack(state)
        given.expect(step=step)
        self._resume(lane, step, given)
        given.end()

    def _resume(self, lane: int, step: int, given: Unpacked) -> None:
        controller = self.controllers[lane]
        if not isinstance(controller, RestartableController):
            raise UsageError("the controller cannot go on: it lacks one of STATE_VERSION, state, set_state")
        given.expect(version=controller.STATE_VERSION)
        controller.set_state(given.group("controller."))
        self._ready[lane].clear()
        if "ready" in given:
            self._ready[lane].append((step, given.array("ready", np.float64, self._lanes[lane], self._q)))
        self._saturated[lane], self._done[lane] = given.number("saturated"), step

    def _listen(self, node: Node, name: str) -> None:
        """Follow the estimates of an estimator: the one place that says whose they are."""
        node.on(node.keys.estimate(name), EstimateMessage, _is_estimator, self._follow)

    def _follow(self, packet: EstimateMessage, arrays: dict[str, NDArray[Any]]) -> None:
        lane, k = packet.lane, packet.step
        if k < self._steps:
            self._compute(k, lane, arrays["x_hat"], arrays["P"])
        self._done[lane] = k
        self._node.done(k, lane)
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
            self._saturated[lane] += saturated
        self._ready[lane].append((k, u))

    def _tick(self, clock: ClockMessage, _: dict[str, NDArray[Any]]) -> None:
        self._granted = min(clock.step, self._steps)
        self._send_ready()

    def _send_ready(self) -> None:
        """Step by step, and block by block in each: so every role sends and takes its packets in one order.

        What is sent again after a restart has the numbers that it had before.
        """
        granted = [(ready[0][0], lane) for lane, ready in self._ready.items() if ready and ready[0][0] < self._granted]
        while granted:
            k, lane = min(granted)
            _, u = self._ready[lane].popleft()
            self._send(k, lane, len(u), {"u": u})
            granted.remove((k, lane))
            if self._ready[lane] and self._ready[lane][0][0] < self._granted:
                granted.append((self._ready[lane][0][0], lane))
