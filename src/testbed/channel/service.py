"""A link as a service: takes what is published on its ``sent`` key and publishes what it delivers on ``delivered``."""

from __future__ import annotations

from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from testbed.channel.loss import LossCounts
from testbed.channel.processes import FateProcess, process_of
from testbed.numerics.lanes import Mask, any_of
from testbed.numerics.streams import Stream
from testbed.scenario import Link, Loss, NoLoss, Scenario
from testbed.wire.keys import LinkName
from testbed.wire.messages import Acknowledgement, Control, Observation, Packet
from testbed.wire.node import Node
from testbed.wire.setup import Setup

_TYPES: dict[LinkName, tuple[type[Packet], str, str]] = {
    "control": (Control, "controller", "u"),
    "observation": (Observation, "plant", "y"),
    "ack": (Acknowledgement, "plant", "nu"),
}
"""Type, sender and content."""


def role_of(link: LinkName) -> str:
    return f"link.{link}"


def builder(link: LinkName) -> Any:
    """What builds the service of one link."""
    return partial(LinkService, link=link)


def loss_of(scenario: Scenario, link: LinkName) -> Loss:
    """The loss of a link; that of an ACK link that is none or perfect loses nothing."""
    settings = getattr(scenario.links, link)
    loss: Loss = settings.loss if isinstance(settings, Link) or settings.mode == "link" else NoLoss()
    return loss


def loss_process(scenario: Scenario, link: LinkName, lane: int, lanes: int) -> FateProcess:
    """The loss process of a block of lanes of a link; the same draws wherever it runs."""

    def stream(purpose: str) -> Stream:
        return Stream(scenario.seed, role_of(link), purpose, width=1, lane=lane, lanes=lanes)

    return process_of(loss_of(scenario, link), stream, lanes)


class LinkService:
    """Emulates one link, lane by lane.

    A packet that arrives in some lanes is passed on with its mask and zeros elsewhere; one that arrives in none is
    passed on as a bare mask, which tells the receiver that the step is over (virtual time has no other way).
    Where the scenario says that noise is received in place of a lost observation, that stands there with mask 0.
    """

    def __init__(self, node: Node, setup: Setup, *, link: LinkName) -> None:
        model, sender, self._content = _TYPES[link]
        self._losses = {lane: loss_process(setup.scenario, link, lane, lanes) for lane, lanes in setup.blocks}
        self._counts = LossCounts()
        self._deliver = node.sender(node.keys.delivered(link), model, tap=True)
        noise = link == "observation" and setup.scenario.links.observation.on_loss == "noise"
        self._instead = "noise" if noise else None
        needs = (self._content, self._instead) if self._instead else (self._content,)
        node.on(node.keys.sent(link), model, sender, self._pass_on, needs=needs)

    @property
    def counters(self) -> dict[str, int]:
        return self._counts.as_counters()

    def _pass_on(self, packet: Packet, arrays: dict[str, NDArray[Any]]) -> None:
        lane = packet.lane
        arrived = self._losses[lane].next(packet.step - packet.FIRST_STEP)
        self._deliver(packet.step, lane, packet.lanes, self._content_of(arrays, arrived))
        self._counts.count(lane, arrived)

    def _content_of(self, arrays: dict[str, NDArray[Any]], arrived: Mask) -> dict[str, NDArray[Any]]:
        if self._instead is not None:
            mask = np.atleast_1d(np.asarray(arrived, dtype=np.bool_))
            content = np.where(mask[:, None], arrays[self._content], arrays[self._instead])
            return {self._content: content, "mask": mask.astype(np.uint8)}
        if not any_of(arrived):
            lanes = 1 if isinstance(arrived, bool) else len(arrived)
            return {"mask": np.zeros(lanes, dtype=np.uint8)}
        content = arrays[self._content]
        if isinstance(arrived, bool):
            return {self._content: content, "mask": _ARRIVED}
        if not arrived.all():
            content = content.copy()
            content[~arrived] = 0
        return {self._content: content, "mask": arrived.astype(np.uint8)}


_ARRIVED = np.ones(1, dtype=np.uint8)
