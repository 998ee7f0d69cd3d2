"""The plant as a service: takes control packets from its link, publishes observation, ACK and truth."""

from __future__ import annotations

from typing import Any

from numpy.typing import NDArray

from testbed.errors import RunFailed
from testbed.numerics.lanes import mask_of
from testbed.plant.dynamics import Plant, bits
from testbed.scenario.plant_events import PlantEvent
from testbed.wire.codec import all_finite
from testbed.wire.messages import Acknowledgement, Change, Control, Observation, Truth
from testbed.wire.node import ORCHESTRATOR, Node
from testbed.wire.setup import Setup
from testbed.wire.state import pack, unpack

ROLE = "plant"


class PlantService:
    """One Plant for each block of lanes."""

    def __init__(self, node: Node, setup: Setup) -> None:
        keys = node.keys
        self._node, self._done = node, {lane: 0 for lane, _ in setup.blocks}
        self._plants = {lane: Plant(setup.scenario, lane, lanes) for lane, lanes in setup.blocks}
        self._costs = setup.costs_input
        self._noise = setup.scenario.links.observation.on_loss == "noise"
        self._truth = node.sender(keys.truth, Truth, lazy=not setup.scenario.waits)
        self._ack = node.sender(keys.sent("ack"), Acknowledgement, tap=True) if setup.acks_are_of_use else None
        self._observe = node.sender(keys.sent("observation"), Observation, tap=True)
        self.counters: dict[str, int] = {}
        node.on(keys.delivered("control"), Control, "link.control", self._move, needs=("mask",))
        node.on(keys.change(ROLE), Change, ORCHESTRATOR, self._change)

    def _change(self, change: Change, _: dict[str, NDArray[Any]]) -> None:
        """Take an order to drift from a step on that is still to come; the orchestrator has checked it."""
        event = PlantEvent.model_validate(change.set)
        for plant in self._plants.values():
            plant.change(change.step, event)

    @property
    def gives_state(self) -> bool:
        return True

    def state(self, lane: int) -> bytes:
        return pack(self._plants[lane].state(), step=self._done[lane])

    def resume(self, lane: int, step: int, state: bytes) -> None:
        """Raises UsageError for what is no state of this plant after so many steps."""
        given = unpack(state)
        given.expect(step=step)
        self._plants[lane].resume(step, given)
        given.end()
        self._done[lane] = step

    def _move(self, packet: Control, arrays: dict[str, NDArray[Any]]) -> None:
        lane, lanes, step = packet.lane, packet.lanes, packet.step + 1
        applied = mask_of(arrays["mask"])
        x, y = self._plants[lane].move(arrays.get("u"), applied)
        if not (all_finite(x) and all_finite(y)):
            raise RunFailed(f"the state left the range of floating-point numbers at step {step}")
        nu = bits(applied)
        self._observe(step, lane, lanes, {"y": y, "noise": self._plants[lane].noise} if self._noise else {"y": y})
        if self._ack is not None:
            self._ack(step, lane, lanes, {"nu": nu})
        truth: dict[str, NDArray[Any]] = {"x": x, "nu": nu}
        if self._costs:
            truth["applied"] = self._plants[lane].applied
        self._truth(step, lane, lanes, truth)
        self._done[lane] = step
        self._node.done(step, lane)
