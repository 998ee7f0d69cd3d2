"""Services alone on the in-process bus: what one publishes from the beginning, or from a state that it gave."""

from __future__ import annotations

import json
from collections import defaultdict
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any
from unittest.mock import patch

from testbed.estimator import service
from testbed.orchestrator.run import Run
from testbed.scenario import Scenario
from testbed.wire.bundle import unbundle
from testbed.wire.handover import Order
from testbed.wire.memory_bus import MemoryBus, MemoryNetwork
from testbed.wire.messages import Packet
from testbed.wire.node import OPEN, Gate, Node
from testbed.wire.setup import Setup

Messages = list[tuple[str, bytes]]
States = dict[int, dict[int, bytes]]
"""By step and block of lanes."""


@dataclass
class Life:
    """What one service did: its packets, the states that it gave after each step, and its counters at the end."""

    build: Callable[[Node, Setup], Any]
    service: Any = None
    states: States = field(default_factory=lambda: defaultdict(dict))
    published: Messages = field(default_factory=list)

    @property
    def counters(self) -> dict[str, int]:
        return dict(self.service.counters)

    def born(self, node: Node, setup: Setup) -> Any:
        node.done = self.note  # type: ignore[method-assign]
        self.service = self.build(node, setup)
        return self.service

    def note(self, step: int, lane: int) -> None:
        if self.service.gives_state:
            assert lane not in self.states[step]
            self.states[step][lane] = self.service.state(lane)


@dataclass
class Whole:
    """A run: all its messages in the order in which they were published, and the lives of its services."""

    setup: Setup
    messages: Messages
    lives: dict[str, Life]


def logged(network: type[MemoryNetwork], log: Messages) -> type[MemoryNetwork]:
    """Such a network that notes what is published."""

    class Logged(network):  # type: ignore[valid-type, misc]
        def _publish(self, key: str, payload: bytes) -> None:
            log.append((key, payload))
            super()._publish(key, payload)

    return Logged


class LateNode(Node):
    """Of a role that begins after ``passed_over`` steps."""

    passed_over: int

    def sender(self, key: str, model: type[Packet], **options: Any) -> Any:
        options["gate"] = self._gate(options.get("gate", OPEN))
        return super().sender(key, model, **options)

    def on(self, key: str, model: Any, *arguments: Any, **options: Any) -> None:
        if issubclass(model, Packet):
            options["gate"] = self._gate(options.get("gate", OPEN))
        super().on(key, model, *arguments, **options)

    def _gate(self, given: Gate) -> Gate:
        return Gate(self.passed_over) if given is OPEN and self.passed_over else given


def header_of(payload: bytes) -> dict[str, Any]:
    if payload[:4] != b"NCS1":
        return {"source": "orchestrator"}
    return dict(json.loads(payload[8 : 8 + int.from_bytes(payload[4:8], "little")]))


def steps_before(payload: bytes) -> int:
    """How many steps of its block are before a packet; 0 for what is no packet."""
    header = header_of(payload)
    return header["step"] - (header["type"] != "control") if "lane" in header else 0


def packets_of(messages: Messages, role: str, begin: int = 0) -> Messages:
    """Those of a role that come after the first ``begin`` steps; copies for the recording are left out."""
    out = []
    for key, payload in messages:
        header = header_of(payload)
        if header["source"] == role and "lane" in header and "/tap/" not in key and steps_before(payload) >= begin:
            out.append((key, payload))
    return out


def whole_run(
    scenario: Scenario, out: Path, schedule: int | None = None, network: type[MemoryNetwork] = MemoryNetwork
) -> Whole:
    """A run in process in which every service gives its state after every step."""
    log: Messages = []
    lives: dict[str, Life] = {}

    def wrapped(build: Any) -> Any:
        def born(node: Node, setup: Setup) -> Any:
            lives[node.name] = Life(build)
            return lives[node.name].born(node, setup)

        return born

    joined, ask = service.builder, MemoryBus.ask

    def asked(bus: MemoryBus, key: str, question: bytes = b"") -> bytes:
        log.append((key, question))
        return ask(bus, key, question)

    with (
        patch.object(MemoryBus, "ask", asked),
        patch("testbed.orchestrator.report.write_report"),
        patch("testbed.orchestrator.run.MemoryNetwork", logged(network, log)),
        patch("testbed.orchestrator.services.builder", lambda name, spec=None: wrapped(joined(name, spec))),
    ):
        run = Run(scenario, out)
        run._roles = [replace(role, build=wrapped(role.build)) for role in run._roles]
        summary = run.in_process(schedule)
    assert summary.status == "complete", summary
    for name, life in lives.items():
        life.published = packets_of(log, name)
    return Whole(run._setup, log, lives)


def live(
    life: Life,
    setup: Setup,
    role: str,
    messages: Sequence[tuple[str, bytes]],
    begin: int = 0,
    states: dict[int, bytes] | None = None,
    network: type[MemoryNetwork] = MemoryNetwork,
) -> Life:
    """A life of such a service alone, which is sent these messages; from the states after ``begin`` steps on.

    The questions among them are orders; those that were given after these steps are given again.
    """
    log: Messages = []
    alone = logged(network, log)()
    node = LateNode.__new__(LateNode)
    node.passed_over = begin
    Node.__init__(node, alone.bus(), setup.run, role, setup.sizes)
    again = Life(life.build)
    again.born(node, setup)
    for lane, state in (states or {}).items():
        again.service.resume(lane, begin, state)
    send = partial(network._publish, alone)
    for key, payload in messages:
        if key == node.keys.handover(role):
            order = Order.model_validate_json(unbundle(payload)[0])
            if order.action in ("serve", "leave") and order.step >= begin:
                node.bus.ask(key, payload)
        elif header_of(payload)["source"] != role:
            send(key, payload)
            alone.run(lambda: False)
    assert not node.rejected, node.rejected
    again.published = packets_of(log, role)
    return again


def check_resumed(
    life: Life, setup: Setup, role: str, messages: Messages, begin: int, network: type[MemoryNetwork] = MemoryNetwork
) -> None:
    """What goes on from the states after ``begin`` steps is, to the bit, what went on."""
    states = life.states[begin]
    assert states.keys() == dict(setup.blocks).keys()
    again = live(life, setup, role, messages, begin, states, network)
    assert again.published == packets_of(life.published, role, begin)
    assert again.counters == life.counters
    for step, given in again.states.items():
        assert step > begin
        assert given == life.states[step]
