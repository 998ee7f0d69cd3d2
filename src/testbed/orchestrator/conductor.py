"""The orchestrator's part of a run, on either bus: wait for the roles, drive the clock, collect, stop."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any, get_args

from numpy.typing import NDArray

from testbed.channel.service import role_of as link_role
from testbed.estimator.bounds_service import ROLE as BOUNDS
from testbed.estimator.service import role_of as estimator_role
from testbed.orchestrator.collect import Collector
from testbed.orchestrator.recorder import Recorder
from testbed.plant.controller import ROLE as CONTROLLER
from testbed.plant.service import ROLE as PLANT
from testbed.wire.bus import Bus
from testbed.wire.codec import encode
from testbed.wire.keys import LinkName
from testbed.wire.messages import (
    Acknowledgement,
    BoundsMessage,
    ClockMessage,
    Command,
    Control,
    EstimateMessage,
    Observation,
    Packet,
    Status,
    Truth,
)
from testbed.wire.node import ORCHESTRATOR, Node
from testbed.wire.setup import Setup

Arrays = dict[str, NDArray[Any]]


class Conductor:
    """States: waiting for roles, running, finished or failed, stopped.

    ``failure`` is the first reason the run cannot go on; ``reports`` the last word of each role.
    """

    def __init__(self, bus: Bus, setup: Setup, roles: list[str], recorder: Recorder | None) -> None:
        self.setup, self.collector = setup, Collector(setup)
        self.failure: str | None = None
        self.reports: dict[str, Status] = {}
        self.activity = 0
        """Grows with every message that was of use."""
        self.on_started: Callable[[], None] = lambda: None
        self._roles = roles
        self._present: set[str] = set()
        self._granted = 0
        self._steps, self._credit = setup.scenario.steps, setup.credit
        self._stopping = False
        self._recorder = recorder
        self.node = Node(bus, setup.run, ORCHESTRATOR, setup.sizes)
        self._clock, self._command = bus.publisher(self.node.keys.clock), bus.publisher(self.node.keys.command)
        self._clock_seq = 0
        self._subscribe()
        bus.answer(self.node.keys.scenario, lambda _: setup.to_json())
        self.node.announce()
        bus.watch(self.node.keys.presence("*"), self._presence)

    @property
    def started(self) -> bool:
        return self._granted > 0

    @property
    def over(self) -> bool:
        """Nothing more will be collected."""
        return self.collector.finished or self.failure is not None

    @property
    def missing(self) -> list[str]:
        """Roles that are not there."""
        return [role for role in self._roles if role not in self._present]

    def fail(self, reason: str) -> None:
        """Note why the run cannot go on; the first reason stays."""
        if self.failure is None and not self.collector.finished:
            self.failure = reason

    def awaiting(self) -> str:
        """What the run is waiting for now."""
        return self.collector.awaiting() if self.started else f"roles to join: {', '.join(self.missing)}"

    def stop(self) -> None:
        """Tell all roles to report and leave."""
        if not self._stopping:
            self._stopping = True
            self._command(encode(Command(run=self.setup.run, source=ORCHESTRATOR, seq=0, action="stop")))

    @property
    def all_reported(self) -> bool:
        """Whether every role that is still there has reported."""
        return all(role in self.reports for role in self._roles if role in self._present)

    def _subscribe(self) -> None:
        node, keys, scenario = self.node, self.node.keys, self.setup.scenario
        for role in self._roles:
            node.on(keys.status(role), Status, role, partial(self._status, role))
        node.on(keys.truth, Truth, PLANT, self._truth)
        for spec in scenario.estimators:
            take = partial(self._estimate, spec.name, f"estimate/{spec.name}")
            node.on(keys.estimate(spec.name), EstimateMessage, estimator_role(spec.name), take, last=spec.until)
        if scenario.bounds:
            node.on(keys.bounds, BoundsMessage, BOUNDS, self._bounds)
        if self._recorder is not None:
            self._subscribe_for_recording()

    def _subscribe_for_recording(self) -> None:
        keys = self.node.keys
        types: dict[LinkName, tuple[type[Packet], str]] = {
            "control": (Control, CONTROLLER),
            "observation": (Observation, PLANT),
            "ack": (Acknowledgement, PLANT),
        }
        for link in get_args(LinkName):
            model, sender = types[link]
            self._record(keys.sent(link), model, sender, f"{link}/sent")
            if link_role(link) in self._roles:
                self._record(keys.delivered(link), model, link_role(link), f"{link}/delivered")

    def _record(self, key: str, model: type[Packet], source: str, topic: str) -> None:
        whole = self.setup.tap >= self.setup.sizes.lanes
        taken = key if whole else self.node.keys.tap(key)
        self.node.on(taken, model, source, partial(self._write, topic), cut=not whole)

    def _write(self, topic: str, packet: Packet, arrays: Arrays) -> None:
        if self._recorder is not None:
            self._recorder.write(topic, packet, arrays, self.node.payload)

    def _presence(self, key: str, alive: bool) -> None:
        role = key.rsplit("/", 1)[1]
        if role not in self._roles:
            return
        if not alive:
            self._present.discard(role)
            if not self._stopping:
                self.fail(f"{role} is gone")
            return
        self._present.add(role)
        self.activity += 1
        if not self.missing and not self.started:
            self.on_started()
            self._advance()

    def _status(self, role: str, status: Status, _: Arrays) -> None:
        self.reports[role] = status
        if status.state == "failed":
            self.fail(f"{role}: {status.detail}")

    def _truth(self, packet: Truth, arrays: Arrays) -> None:
        self.collector.truth(packet.step, packet.lane, arrays)
        self._collected("truth", packet, arrays)

    def _estimate(self, name: str, topic: str, packet: EstimateMessage, arrays: Arrays) -> None:
        self.collector.estimate(name, packet.step, packet.lane, arrays)
        self._collected(topic, packet, arrays)

    def _bounds(self, packet: BoundsMessage, arrays: Arrays) -> None:
        self.collector.bound(packet.step, packet.lane, arrays)
        self._collected("bounds", packet, arrays)

    def _collected(self, topic: str, packet: Packet, arrays: Arrays) -> None:
        self.activity += 1
        self._write(topic, packet, arrays)
        self._advance()

    def _advance(self) -> None:
        """Grant the steps that may be in flight, several at a time."""
        steps, credit = self._steps, self._credit
        target = min(steps, self.collector.estimated + credit)
        if target > self._granted and (target == steps or target - self._granted >= max(1, credit // 4)):
            self._granted = target
            clock = ClockMessage(run=self.setup.run, source=ORCHESTRATOR, seq=self._clock_seq, step=target)
            self._clock_seq += 1
            self._clock(encode(clock))
