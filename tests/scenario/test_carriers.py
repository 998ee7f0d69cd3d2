"""The key `transport` of a link's table."""

from __future__ import annotations

from typing import Any

import pytest
from pydantic import TypeAdapter, ValidationError

from testbed.channel.carriers import carriers_of
from testbed.channel.tcp import TcpCarrier
from testbed.channel.udp import UdpCarrier
from testbed.scenario.carriers import LinkTransport, TcpTransport, UdpTransport
from testbed.scenario.links import Link

ADAPTER: TypeAdapter[UdpTransport | TcpTransport] = TypeAdapter(LinkTransport)


def test_the_kind_chooses_the_part_and_the_carrier() -> None:
    for kind, part, carrier in (("udp", UdpTransport, UdpCarrier), ("tcp", TcpTransport, TcpCarrier)):
        settings = ADAPTER.validate_python({"kind": kind})
        assert settings == part()
        assert type(carriers_of(Link(transport=settings), 1, "link.test", 0, 1)[0]) is carrier


@pytest.mark.parametrize(
    ("keys", "problem"),
    [
        ({"kind": "udp", "mtu": 67}, "greater than or equal to 68"),
        ({"kind": "udp", "late": "keep"}, "'drop' or 'deliver'"),
        ({"kind": "udp", "mss": 1000}, "Extra inputs"),
        ({"kind": "tcp", "congestion": "bbr"}, "'cubic' or 'reno'"),
        ({"kind": "tcp", "mss": 2000, "buffer_bytes": 1999}, "got 1999; allowed: at least mss, which is 2000"),
        ({"kind": "tcp", "keep_alive": "1 s"}, "got '1 s' without delayed_ack; allowed: only with it"),
        ({"kind": "tcp", "lease": "0 s"}, "allowed"),
        ({"kind": "sctp"}, "'udp', 'tcp'"),
    ],
)
def test_wrong_settings_are_refused(keys: dict[str, Any], problem: str) -> None:
    with pytest.raises(ValidationError, match=problem):
        ADAPTER.validate_python(keys)
