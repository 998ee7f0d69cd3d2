"""An estimator as a service: joins what it may see of each step, and publishes x̂ and P."""

from __future__ import annotations

from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from testbed.errors import RunFailed
from testbed.estimator.buffers import acks_of, buffer_of
from testbed.estimator.model import Ack, Estimator, Restartable, seen
from testbed.estimator.refilter import LateObservation, Refilter
from testbed.estimator.registry import create, model_of
from testbed.numerics.lanes import Floats
from testbed.scenario import EstimatorSpec, Scenario
from testbed.wire.codec import all_finite
from testbed.wire.messages import Acknowledgement, Control, EstimateMessage, Observation, Packet
from testbed.wire.node import Node
from testbed.wire.setup import Setup


def role_of(name: str) -> str:
    return f"estimator.{name}"


def builder(name: str) -> Any:
    """What builds the service of the estimator of that name."""
    return partial(EstimatorService, name=name)


def spec_of(scenario: Scenario, name: str) -> EstimatorSpec:
    return next(spec for spec in scenario.estimators if spec.name == name)


class _Block:
    """The parts of coming steps of one block of lanes."""

    def __init__(self, estimator: Estimator, buffer: int, lanes: int, parts: int) -> None:
        """buffer: steps that the estimator can go back, where it gives its state."""
        self.estimator, self.lanes = estimator, lanes
        self.refilter = Refilter(estimator, buffer if isinstance(estimator, Restartable) else 0)
        self._parts = parts
        self._waiting: dict[int, dict[str, dict[str, NDArray[Any]]]] = {}

    def join(self, step: int, part: str, arrays: dict[str, NDArray[Any]]) -> dict[str, dict[str, NDArray[Any]]] | None:
        """The whole step once its last part is there."""
        whole = self._waiting.setdefault(step, {})
        whole[part] = arrays
        return self._waiting.pop(step) if len(whole) == self._parts else None


class EstimatorService:
    """Sees u as sent, what arrives of y, and what arrives of its ACKs; never the truth."""

    def __init__(self, node: Node, setup: Setup, *, name: str) -> None:
        scenario = setup.scenario
        spec = spec_of(scenario, name)
        acks = acks_of(scenario, spec)
        model = model_of(scenario)
        self._name, self._model = name, model
        self._noise = scenario.links.observation.on_loss == "noise"
        self._until = spec.until or scenario.steps
        self._send = node.sender(node.keys.estimate(name), EstimateMessage)
        self._blocks = {
            lane: _Block(
                create(spec.kind, model, lanes=lanes, options=spec.options, lane=lane),
                buffer_of(scenario, spec),
                lanes,
                2 if acks == "none" else 3,
            )
            for lane, lanes in setup.blocks
        }
        keys = node.keys
        take_u, take_y = partial(self._take, "u", 1), partial(self._take, "y", 0)
        take_ack = partial(self._take, "ack", 0)
        node.on(keys.sent("control"), Control, "controller", take_u, needs=("u",))
        node.on(keys.delivered("observation"), Observation, "link.observation", take_y, needs=("mask",))
        if acks == "perfect":
            node.on(keys.sent("ack"), Acknowledgement, "plant", take_ack, needs=("nu",))
        elif acks == "link":
            node.on(keys.delivered("ack"), Acknowledgement, "link.ack", take_ack, needs=("mask",))

    @property
    def counters(self) -> dict[str, int]:
        total: dict[str, int] = {}
        for block in self._blocks.values():
            for key, value in block.refilter.counters.items():
                total[key] = total.get(key, 0) + value
        return total

    def _take(self, part: str, ahead: int, packet: Packet, arrays: dict[str, NDArray[Any]]) -> None:
        step = packet.step + ahead
        if step > self._until:
            return
        whole = self._blocks[packet.lane].join(step, part, arrays)
        if whole is not None:
            self._estimate(step, packet.lane, whole)

    def _estimate(self, step: int, lane: int, parts: dict[str, dict[str, NDArray[Any]]]) -> None:
        block = self._blocks[lane]
        observation = parts["y"]
        y: Floats = observation["y"] if "y" in observation else np.zeros((block.lanes, self._model.p))
        mask = observation["mask"]
        received = np.ones(block.lanes, dtype=np.uint8) if self._noise else mask
        arrived = seen(block.estimator, mask, received)
        late = _late_observations(observation)
        estimate = block.refilter.step(parts["u"]["u"], y, arrived, _acks(step, parts.get("ack")), late)
        x_hat, P = estimate.x_hat, estimate.P
        if not (all_finite(x_hat) and all_finite(P)):
            raise RunFailed(f"the estimate of '{self._name}' left the range of floating-point numbers at step {step}")
        arrays = {"x_hat": x_hat, "P": P}
        if estimate.error_bound is not None and estimate.error_bound_P is not None:
            arrays |= {"error_bound": estimate.error_bound, "error_bound_P": estimate.error_bound_P}
        self._send(step, lane, block.lanes, arrays)


def _acks(step: int, arrays: dict[str, NDArray[Any]] | None) -> tuple[Ack, ...]:
    """The ACKs that came with a step: on a perfect path without a mask, on a link with one; late ones behind."""
    if arrays is None:
        return ()
    out = []
    if "nu" in arrays:
        nu = arrays["nu"]
        out.append(Ack(step - 1, nu, arrays.get("mask", np.ones(len(nu), dtype=np.uint8))))
    if "late_nu" in arrays:
        nu, known = arrays["late_nu"], arrays["late_mask"]
        out += [Ack(int(of) - 1, nu[:, i], known[:, i]) for i, of in enumerate(arrays["late_step"][0])]
    return tuple(out)


def _late_observations(arrays: dict[str, NDArray[Any]]) -> tuple[LateObservation, ...]:
    if "late_y" not in arrays:
        return ()
    y, arrived = arrays["late_y"], arrays["late_mask"]
    return tuple(LateObservation(int(of), y[:, i], arrived[:, i]) for i, of in enumerate(arrays["late_step"][0]))
