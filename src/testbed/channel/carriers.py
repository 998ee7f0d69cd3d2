"""The carrier that a link's settings ask for."""

from __future__ import annotations

from testbed.channel.carrier import Carrier
from testbed.channel.pipeline import Pipeline
from testbed.channel.tcp import TcpCarrier
from testbed.channel.udp import UdpCarrier
from testbed.scenario.carriers import TcpTransport, UdpTransport


def carrier_of(settings: UdpTransport | TcpTransport, forward: Pipeline, backward: Pipeline) -> Carrier:
    """``backward`` carries what the transport itself sends back; datagrams do not use it."""
    if isinstance(settings, UdpTransport):
        return UdpCarrier(forward, settings)
    return TcpCarrier(forward, backward, settings)
