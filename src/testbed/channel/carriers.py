"""From the scenario's words for a link to what carries its messages."""

from __future__ import annotations

from testbed.channel.carrier import Carrier, Datagrams
from testbed.channel.pipeline import Pipeline
from testbed.channel.tcp import TcpCarrier
from testbed.channel.udp import UdpCarrier
from testbed.scenario.carriers import TcpTransport, UdpTransport
from testbed.scenario.links import Impairments


def carriers_of(link: Impairments, seed: int, component: str, lane: int, lanes: int) -> list[Carrier]:
    """A carrier for each of the lanes lane … lane + lanes − 1; the same draws however lanes are split."""
    return [Datagrams(Pipeline(link, seed, component, lane + i)) for i in range(lanes)]


def carrier_of(settings: UdpTransport | TcpTransport, forward: Pipeline, backward: Pipeline) -> Carrier:
    """``backward`` carries what the transport itself sends back; datagrams do not use it."""
    if isinstance(settings, UdpTransport):
        return UdpCarrier(forward, settings)
    return TcpCarrier(forward, backward, settings)
