"""From the scenario's words for a link to what carries its messages."""

from __future__ import annotations

from testbed.channel.carrier import Carrier, Datagrams
from testbed.channel.pipeline import Pipeline
from testbed.channel.tcp import TcpCarrier
from testbed.channel.udp import UdpCarrier
from testbed.scenario.carriers import UdpTransport
from testbed.scenario.links import SteppedImpairments


def carriers_of(link: SteppedImpairments, seed: int, component: str, lane: int, lanes: int) -> list[Carrier]:
    """A carrier for each of the lanes lane … lane + lanes − 1; the same draws however lanes are split."""
    return [_carrier_of(link, seed, component, lane + i) for i in range(lanes)]


def _carrier_of(link: SteppedImpairments, seed: int, component: str, lane: int) -> Carrier:
    forward = Pipeline(link, seed, component, lane)
    if link.transport is None:
        return Datagrams(forward)
    if isinstance(link.transport, UdpTransport):
        return UdpCarrier(forward, link.transport)
    backward = Pipeline(link.backwards, seed, f"{component}.back", lane)
    return TcpCarrier(forward, backward, link.transport)
