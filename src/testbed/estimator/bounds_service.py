"""The bounds of the error covariance as a service, on the same observation losses as the estimators."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from testbed.errors import RunFailed
from testbed.estimator.bounds import Bounds, LateBound, upper_bound
from testbed.estimator.registry import model_of
from testbed.numerics.lanes import Component, trace
from testbed.plant.inputs import control_bound
from testbed.wire.codec import all_finite
from testbed.wire.messages import BoundsMessage, Observation
from testbed.wire.node import Node
from testbed.wire.setup import Setup
from testbed.wire.state import pack, unpack

ROLE = "bounds"
_DEPTH = 256
"""Steps that the lower bound goes back for a late observation."""


class BoundsService:
    """Publishes the traces of Pᴬ_k and S_k of every lane, and under correlated control losses of the correlated S_k.

    The lower bound uses late observations, the upper ones do not: so they hold whether an estimator does or does not.
    """

    def __init__(self, node: Node, setup: Setup) -> None:
        self._node, self._done = node, {lane: 0 for lane, _ in setup.blocks}
        model, bound = model_of(setup.scenario), control_bound(setup.scenario)
        factor = None if model.holds else model.control.covariance_factor
        self._blocks = {lane: Bounds(model, bound, lanes) for lane, lanes in setup.blocks}
        self._correlated = {
            lane: upper_bound(model, factor * bound, lanes)
            for lane, lanes in setup.blocks
            if bound is not None and factor is not None and factor > 1.0
        }
        self._late = {
            lane: LateBound(model, lanes, _DEPTH)
            for lane, lanes in setup.blocks
            if setup.scenario.takes_time("observation")
        }
        self._send = node.sender(node.keys.bounds, BoundsMessage, lazy=True)
        node.on(node.keys.delivered("observation"), Observation, "link.observation", self._take, needs=("mask",))

    @property
    def counters(self) -> dict[str, int]:
        old = sum(bound.old for bound in self._late.values())
        return {"old_observations": old} if old else {}

    @property
    def gives_state(self) -> bool:
        return True

    def state(self, lane: int) -> bytes:
        arrays: dict[str, NDArray[Any]] = {**self._blocks[lane].state()}
        if lane in self._correlated:
            arrays["correlated"] = self._correlated[lane].state
        late = self._late.get(lane)
        if late is not None:
            arrays |= late.state()
        return pack(arrays, step=self._done[lane], old=0 if late is None else late.old)

    def resume(self, lane: int, step: int, state: bytes) -> None:
        """Raises UsageError for what is no state of these bounds after so many steps."""
        given = unpack(state)
        given.expect(step=step)
        self._blocks[lane].resume(given)
        if lane in self._correlated:
            self._correlated[lane].resume(given, "correlated")
        old, late = given.number("old"), self._late.get(lane)
        if late is not None:
            late.resume(step, given, old)
        given.end()
        self._done[lane] = step

    def _take(self, packet: Observation, arrays: dict[str, NDArray[Any]]) -> None:
        lower, upper = self._blocks[packet.lane].components(arrays["mask"])
        if packet.lane in self._late:
            late = [(int(of), arrays["late_mask"][:, i]) for i, of in enumerate(_steps(arrays))]
            lower = self._late[packet.lane].step(arrays["mask"], late)
        traces = {"trace_lower": _lanes(trace(lower), packet.lanes)}
        if upper is not None:
            traces["trace_upper"] = _lanes(trace(upper), packet.lanes)
        if packet.lane in self._correlated:
            correlated = self._correlated[packet.lane].step(arrays["mask"])
            traces["trace_upper_correlated"] = _lanes(trace(correlated), packet.lanes)
        if not all(all_finite(values) for values in traces.values()):
            raise RunFailed(f"the bounds left the range of floating-point numbers at step {packet.step}")
        self._send(packet.step, packet.lane, packet.lanes, traces)
        self._done[packet.lane] = packet.step
        self._node.done(packet.step, packet.lane)


def _steps(arrays: dict[str, NDArray[Any]]) -> NDArray[Any]:
    return arrays["late_step"][0] if "late_step" in arrays else np.zeros(0)


def _lanes(component: Component, lanes: int) -> NDArray[np.float64]:
    return np.array(np.broadcast_to(component, (lanes,)))


if __name__ == "__main__":
    import sys

    from testbed.wire.process import main

    sys.exit(main(None, ROLE, BoundsService, "The bounds of the error covariance of a run."))
