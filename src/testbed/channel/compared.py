"""What a scenario says of the packets of a link, for a comparison with a trace of it; and what it cannot say."""

from __future__ import annotations

from dataclasses import dataclass

from testbed.channel.chains import chain_of
from testbed.channel.delay import Law, law_of
from testbed.channel.law import LossModel
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
    settings = getattr(scenario.links, link)
    notes = []
    losses: LossModel | None = chain_of(settings.loss)
    if settings.loss.kind in _REPLAYED:
        losses = None
        notes.append("the losses are replayed: there is no law to compare with")
    elif settings.clock == "time":
        losses = None
        notes.append("the chain of the losses moves by time: by packet it has no law to compare with")
    elif settings.rate is not None and (settings.rate.queue_packets or settings.rate.queue_bytes):
        notes.append("the queue of the link may drop packets besides those that the loss model loses")
    delay = None if settings.delay is None else law_of(settings.delay)
    why = _why_delays_differ(settings)
    if delay is not None and why:
        delay = None
        notes.append(f"delays have no law to compare with: {why}")
    return Comparable(losses, delay, tuple(notes))


def _why_delays_differ(settings: object) -> str:
    rate, reorder, delay = (getattr(settings, key) for key in ("rate", "reorder", "delay"))
    if rate is not None:
        return "the queue adds to them"
    if reorder is not None:
        return "some packets are held back"
    return "packets wait for each other" if not isinstance(delay, ConstantDelay) and delay and delay.in_order else ""
