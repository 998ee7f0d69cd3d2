"""An estimator as a service: joins what it may see of each step, and publishes x̂ and P."""

from __future__ import annotations

from collections.abc import Mapping
from contextlib import suppress
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from testbed.errors import RunFailed, UsageError
from testbed.estimator.appointments import Appointments, Form
from testbed.estimator.buffers import acks_of, buffer_of
from testbed.estimator.handover import give, start
from testbed.estimator.model import Ack, Estimate, Estimator, Restartable, seen
from testbed.estimator.outlet import Outlet
from testbed.estimator.refilter import LateObservation, Refilter
from testbed.estimator.registry import create, model_of
from testbed.numerics.lanes import Floats
from testbed.scenario import EstimatorSpec, Scenario
from testbed.wire.codec import all_finite
from testbed.wire.handover import Behind, Order, answered
from testbed.wire.messages import Acknowledgement, Control, EstimateMessage, Observation, Packet
from testbed.wire.node import OPEN, Gate, Node
from testbed.wire.setup import Setup
from testbed.wire.state import pack, unpack


def role_of(name: str) -> str:
    return f"estimator.{name}"


def builder(name: str, spec: EstimatorSpec | None = None) -> Any:
    """What builds the service of the estimator of that name; ``spec``: of one that joins while the run goes."""
    return partial(EstimatorService, name=name, spec=spec)


def spec_of(scenario: Scenario, name: str) -> EstimatorSpec:
    return next(spec for spec in scenario.estimators if spec.name == name)


class _Block:
    """The parts of coming steps of one block of lanes."""

    def __init__(self, estimator: Estimator, buffer: int, lanes: int, parts: int) -> None:
        """buffer: steps that the estimator can go back, where it gives its state."""
        self.estimator, self.lanes = estimator, lanes
        self.done = 0
        """Steps of which the estimate was given."""
        self.latest: Estimate | None = None
        self.counted: dict[str, int] | None = None
        """The counters, where what it does now is not to count."""
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

    def __init__(self, node: Node, setup: Setup, *, name: str, spec: EstimatorSpec | None = None) -> None:
        """spec: of one that joins while the run goes: it waits until it is told from where it starts."""
        scenario = setup.scenario
        self.gate = Gate(None) if spec is not None else OPEN
        if spec is None:
            spec = spec_of(scenario, name)
        acks = acks_of(scenario, spec)
        model = model_of(scenario)
        self._node, self._name, self._model = node, name, model
        self._noise = scenario.links.observation.on_loss == "noise"
        self.until = spec.until or scenario.steps
        self.outlet = Outlet(name, node.sender(node.keys.estimate(name), EstimateMessage, gate=self.gate))
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
        gate = self.gate
        node.on(keys.sent("control"), Control, "controller", take_u, needs=("u",), gate=gate)
        node.on(keys.delivered("observation"), Observation, "link.observation", take_y, needs=("mask",), gate=gate)
        if acks == "perfect":
            node.on(keys.sent("ack"), Acknowledgement, "plant", take_ack, needs=("nu",), gate=gate)
        elif acks == "link":
            node.on(keys.delivered("ack"), Acknowledgement, "link.ack", take_ack, needs=("mask",), gate=gate)
        self._appointments: Appointments | None = None
        if setup.real:
            if self.gate is not OPEN:
                self._rehearse(spec, setup)
            self._appointments = Appointments(node, self)
        else:
            node.bus.answer(keys.handover(node.name), partial(answered, self._ordered))
        for order, data in node.begin.orders:
            if order.action == "take":
                self._ordered(order, data)
            elif order.action == "leave":
                self.until = min(self.until, order.step)
            elif order.name is not None:
                self.serve(order.name, order.step)

    @property
    def counters(self) -> dict[str, int]:
        total: dict[str, int] = {}
        for block in self._blocks.values():
            counters = block.refilter.counters if block.counted is None else block.counted
            for key, value in counters.items():
                total[key] = total.get(key, 0) + value
        return total

    @property
    def gives_state(self) -> bool:
        return all(isinstance(block.estimator, Restartable) for block in self._blocks.values())

    def state(self, lane: int) -> bytes:
        """A full snapshot, and the name under which the estimates go."""
        snapshot, done = self.give(lane, "full"), self._blocks[lane].done
        return pack({"snapshot": _bytes(snapshot), "name": _bytes(self.outlet.name_at(done).encode())}, step=done)

    def resume(self, lane: int, step: int, state: bytes) -> None:
        """Raises UsageError for what is no state of this estimator after so many steps."""
        given, block = unpack(state), self._blocks[lane]
        done = min(step, self.until)
        given.expect(step=done)
        snapshot, name = (given.array(part, np.uint8, None).tobytes() for part in ("snapshot", "name"))
        given.end()
        block.latest = start(block.refilter, "full", snapshot, model=self._model, lanes=block.lanes, step=done)
        block.done = done
        if self.gate is not OPEN:
            self.gate.passed_over = step
        if name != self.outlet.name_at(step).encode():
            self.serve(name.decode(), step)

    def serve(self, name: str, step: int) -> None:
        """Let the estimates of step + 1 and later go under a name."""
        send = self._node.sender(self._node.keys.estimate(name), EstimateMessage, gate=Gate(step))
        self.outlet.turn(name, send, after=step)

    def done(self) -> Mapping[int, int]:
        """Steps that are done, by first lane of the block."""
        return {lane: block.done for lane, block in self._blocks.items()}

    def give(self, lane: int, form: Form) -> bytes:
        """The state of a block, as a snapshot; not if cold."""
        block = self._blocks[lane]
        if form == "cold":
            raise UsageError("a cold start needs no state")
        estimate = block.latest or Estimate(*self._model.prior(block.lanes), block.lanes)
        return give(block.refilter, form, step=block.done, estimate=estimate)

    def start(self, lane: int, form: Form, data: bytes, step: int) -> None:
        """Let a block that has done nothing go on after ``step``. Raises UsageError where it cannot."""
        block = self._blocks[lane]
        if block.done or self.gate is OPEN:
            raise UsageError("asked to start anew in the middle")
        block.latest = start(block.refilter, form, data, model=self._model, lanes=block.lanes, step=step)
        block.done = step

    def count_until_now(self, lane: int) -> None:
        """Let the counters of a block be what they are now, whatever it still does."""
        block = self._blocks[lane]
        block.counted = dict(block.refilter.counters)

    def count_on(self) -> None:
        """Let all count again, and what they have counted since."""
        for block in self._blocks.values():
            block.counted = None

    def _rehearse(self, spec: EstimatorSpec, setup: Setup) -> None:
        """Let an estimator that nobody sees do what this one will have to do in time: the first time takes longer."""
        model = self._model
        for lane, lanes in setup.blocks[:1]:
            refilter = Refilter(create(spec.kind, model, lanes=lanes, options=spec.options, lane=lane), 0)
            with suppress(Exception):  # what is wrong with it shows when it counts
                estimate = start(refilter, "cold", b"", model=model, lanes=lanes, step=1)
                data = give(refilter, "moments", step=1, estimate=estimate)
                refilter = Refilter(create(spec.kind, model, lanes=lanes, options=spec.options, lane=lane), 0)
                start(refilter, "moments", data, model=model, lanes=lanes, step=1)
                arrived = seen(refilter.estimator, np.ones(lanes, dtype=np.uint8), np.ones(lanes, dtype=np.uint8))
                for _ in range(2):
                    refilter.step(np.zeros((lanes, model.q)), np.zeros((lanes, model.p)), arrived, (), ())

    def _ordered(self, order: Order, data: bytes) -> bytes:
        """Do what the orchestrator asks at a step at which the clock stands still."""
        step = order.step
        if order.action in ("give", "take"):
            block = self._blocks.get(order.lane)
            if block is None:
                raise UsageError(f"no block of lanes begins at {order.lane}")
            if order.action == "take":
                self.start(order.lane, order.form, data, step)
                self.gate.open(step)
                return b""
            if block.done != step:
                raise UsageError(f"asked for the state after step {step}, and is at {block.done}")
            return self.give(order.lane, order.form)
        if any(block.done < min(step, self.until) for block in self._blocks.values()):
            raise Behind
        if any(block.done != min(step, self.until) for block in self._blocks.values()):
            raise UsageError(f"asked after step {step}, and is at another")
        if order.action == "leave":
            self._node.stopped = True
        elif order.action == "ready":
            return b""
        elif order.name is not None:
            self.serve(order.name, step)
            self.outlet.release()
        return b""

    def _take(self, part: str, ahead: int, packet: Packet, arrays: dict[str, NDArray[Any]]) -> None:
        step = packet.step + ahead
        if self._node.stopped:
            return
        if step > self.until:
            if part == "y":
                self._node.done(step, packet.lane)
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
        block.done, block.latest = step, estimate
        self.outlet(step, lane, block.lanes, arrays)
        self._node.done(step, lane)
        if self._appointments is not None:
            self._appointments.done(step, lane)


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


def _bytes(data: bytes) -> NDArray[np.uint8]:
    return np.frombuffer(data, dtype=np.uint8)
