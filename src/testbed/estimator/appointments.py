"""What an estimator's service is told to do after a step to come, in real time, where no clock stands still for it.

A service that is to leave gives its state after its last step, and goes on without publishing until it knows that the
other has begun: if that fails, it publishes what it has held back, and nothing is missing. So a step that two services
have done is published by one, and the old one never waits.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Literal, Protocol

from testbed.errors import UsageError
from testbed.estimator.outlet import Outlet
from testbed.wire.ahead import Ahead, Handed, Word, pack, unpack
from testbed.wire.node import OPEN, Gate, Node

Form = Literal["cold", "moments", "full"]


class Changing(Protocol):
    """What of a service changes with it."""

    gate: Gate
    outlet: Outlet
    until: int

    def done(self) -> Mapping[int, int]:
        """Steps that are done, by first lane of the block."""
        ...

    def give(self, lane: int, form: Form) -> bytes: ...

    def serve(self, name: str, step: int) -> None:
        """Let the estimates of later steps go under a name."""
        ...

    def start(self, lane: int, form: Form, data: bytes, step: int) -> None:
        """Let a block go on after ``step``. Raises a TestbedError where it cannot."""
        ...

    def count_until_now(self, lane: int) -> None:
        """Let the counters of a block be what they are now, whatever it still does."""
        ...

    def count_on(self) -> None:
        """Let all count again, and what they have counted since."""
        ...


class Appointments:
    """Takes orders, and is told of each step that is done."""

    def __init__(self, node: Node, service: Changing) -> None:
        self._node, self._service = node, service
        self._joining: Ahead | None = None
        self._handing: list[Ahead] = []
        self._leaving: Ahead | None = None
        self._states: dict[tuple[int, int], bytes] = {}
        self._say = node.bus.publisher(node.keys.said(node.name))
        node.bus.subscribe(node.keys.handed(node.name), self._handed)
        node.bus.subscribe(node.keys.told(node.name), self._told)

    def done(self, step: int, lane: int) -> None:
        """A block has done a step, and published it."""
        for order in self._handing:
            if step == min(order.step, self._service.until):
                self._hand_over(order, lane)
        self._leave_if_done()

    def _told(self, _: str, payload: bytes) -> None:
        order = Ahead.model_validate_json(payload)
        if order.action in ("hand", "begin", "serve") and self._is_over(order):
            self._word(order, "late")
            return
        try:
            getattr(self, f"_{order.action}")(order)
        except Exception as error:
            self._refuse(order, error)

    def _is_over(self, order: Ahead) -> bool:
        if order.action == "begin":
            return self._service.gate.gone_by > order.step
        return any(done > order.step for done in self._service.done().values())

    def _hand(self, order: Ahead) -> None:
        assert order.to is not None
        self._handing.append(order)
        if order.stop:
            self._service.outlet.held_after = order.step
        self._word(order, "ready")
        for lane, done in self._service.done().items():
            if done == min(order.step, self._service.until):
                self._hand_over(order, lane)

    def _hand_over(self, order: Ahead, lane: int) -> None:
        assert order.to is not None
        if order.stop:
            self._service.count_until_now(lane)
        data = b"" if order.form == "cold" else self._service.give(lane, order.form)
        self._node.bus.publisher(self._node.keys.handed(order.to))(pack(Handed(step=order.step, lane=lane), data))

    def _begin(self, order: Ahead) -> None:
        gate = self._service.gate
        if gate is OPEN or gate.passed_over is not None:
            raise UsageError("asked to start anew in the middle")
        gate.keep()
        self._join(order)

    def _serve(self, order: Ahead) -> None:
        self._service.outlet.held_after = order.step
        self._join(order)

    def _join(self, order: Ahead) -> None:
        self._joining = order
        if order.handed:
            self._word(order, "ready")
        else:
            self._states |= {(order.step, lane): b"" for lane in self._service.done()}
        self._join_if_all_is_there()

    def _handed(self, _: str, payload: bytes) -> None:
        handed, data = unpack(payload)
        self._states[handed.step, handed.lane] = data
        self._join_if_all_is_there()

    def _join_if_all_is_there(self) -> None:
        order, lanes = self._joining, self._service.done().keys()
        if order is None or not {(order.step, lane) for lane in lanes} <= self._states.keys():
            return
        self._joining = None
        states, self._states = {lane: self._states[order.step, lane] for lane in lanes}, {}
        if order.action == "begin":
            try:
                for lane, data in states.items():
                    self._service.start(lane, order.form, data, order.step)
            except Exception as error:
                self._refuse(order, error)
                return
        self._word(order, "begun", size=sum(map(len, states.values())))
        if order.action == "begin":
            self._service.gate.open(order.step)
        else:
            assert order.name is not None
            self._service.serve(order.name, order.step)
            self._service.outlet.release()

    def _stay(self, order: Ahead) -> None:
        held = any(handing.stop for handing in self._handing if handing.to == order.to)
        self._handing = [handing for handing in self._handing if handing.to != order.to]
        if held:
            self._service.count_on()
            self._service.outlet.release()
        if self._joining is not None and self._joining.action == "serve" and order.to is None:
            self._joining = None
            self._service.outlet.release()

    def _leave(self, order: Ahead) -> None:
        if self._service.outlet.held_after != order.step:
            if self._is_over(order):
                self._word(order, "late")
                return
            self._service.outlet.held_after = order.step
        self._leaving = order
        self._word(order, "ready")
        self._leave_if_done()

    def _leave_if_done(self) -> None:
        order = self._leaving
        if order is not None:
            last = min(order.step, self._service.until)
            self._node.stopped = all(done >= last for done in self._service.done().values())

    def _refuse(self, order: Ahead, error: Exception) -> None:
        self._word(
            order, "refused", f"{type(error).__name__ + ': ' if type(error).__module__ == 'builtins' else ''}{error}"
        )

    def _word(
        self, order: Ahead, state: Literal["ready", "begun", "late", "refused"], detail: str = "", size: int = 0
    ) -> None:
        word = Word(number=order.number, state=state, detail=" ".join(detail.split())[:2000], bytes=size)
        self._say(word.model_dump_json().encode())
