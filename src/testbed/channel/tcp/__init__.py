"""A connection that retransmits, as an event model of the kernel's TCP."""

from testbed.channel.tcp.carrier import TcpCarrier

__all__ = ["TcpCarrier"]
