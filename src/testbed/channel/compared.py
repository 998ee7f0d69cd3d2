"""What a scenario says of the packets of a link, for a comparison with a trace of it; and what it cannot say."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

from testbed.channel.chains import chain_of
from testbed.channel.delay import Law, law_of
from testbed.channel.law import LossModel
from testbed.channel.service import loss_of
from testbed.scenario import Scenario
from testbed.scenario.impairments import ConstantDelay
from testbed.wire.keys import LinkName

_REPLAYED = ("trace", "scripted")


@dataclass(frozen=True)
class Comparable:
    """losses: None where bursts and gaps follow no law by packet. notes: why something is not compared."""

    losses: LossModel | None
    delay: Law | None
    notes: tuple[str, ...]


def comparable(scenario: Scenario, link: LinkName) -> Comparable:
    """The laws of a link, as far as they are those of its packets one by one."""
    settings, loss = getattr(scenario.links, link), loss_of(scenario, link)
    if why := _why_nothing_is_compared(scenario, link, settings):
        return Comparable(None, None, (f"no law to compare with: {why}",))
    notes, losses, delay = list(_besides(settings)), None, None
    if loss.kind in _REPLAYED:
        notes.append("losses have no law to compare with: they are replayed")
    elif settings.clock == "time":
        notes.append("losses have no law to compare with: their chain moves by time")
    else:
        losses = chain_of(loss)
    if settings.delay is not None:
        if why := _why_delays_differ(settings):
            notes.append(f"delays have no law to compare with: {why}")
        else:
            delay = law_of(settings.delay)
    return Comparable(losses, delay, tuple(notes))


def _why_nothing_is_compared(scenario: Scenario, link: LinkName, settings: Any) -> str:
    if scenario.changes_of(link):
        return "events of the scenario change the link"
    carried = settings.transport is not None
    return "what carries the messages decides over them too" if carried else ""


def _besides(settings: Any) -> Iterable[str]:
    if settings.rate is not None and (settings.rate.queue_packets or settings.rate.queue_bytes):
        yield "the queue of the link may drop packets besides those that the loss model loses"
    if settings.corrupt is not None:
        yield "packets with a bit flipped are lost besides those that the loss model loses"


def _why_delays_differ(settings: Any) -> str:
    if settings.rate is not None:
        return "the queue adds to them"
    if settings.reorder is not None:
        return "some packets are held back"
    in_order = not isinstance(settings.delay, ConstantDelay) and settings.delay.in_order
    return "packets wait for each other" if in_order else ""
