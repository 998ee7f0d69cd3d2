"""The key `transport` of a link's table."""

from __future__ import annotations

from typing import Any

import pytest
from pydantic import TypeAdapter, ValidationError

from testbed.channel.carriers import carrier_of
from testbed.channel.pipeline import Pipeline
from testbed.channel.tcp import TcpCarrier
from testbed.channel.udp import UdpCarrier
from testbed.scenario.carriers import LinkTransport, TcpTransport, UdpTransport
from testbed.scenario.links import Impairments

ADAPTER: TypeAdapter[UdpTransport | TcpTransport] = TypeAdapter(LinkTransport)


def test_the_kind_chooses_the_part_and_the_carrier() -> None:
    pipelines = [Pipeline(Impairments(), 1, name) for name in ("forward", "backward")]
    for kind, part, carrier in (("udp", UdpTransport, UdpCarrier), ("tcp", TcpTransport, TcpCarrier)):
        settings = ADAPTER.validate_python({"kind": kind})
        assert settings == part()
        assert type(carrier_of(settings, *pipelines)) is carrier


@pytest.mark.parametrize(
    ("keys", "problem"),
    [
        ({"kind": "udp", "mtu": 67}, "greater than or equal to 68"),
        ({"kind": "udp", "late": "keep"}, "'drop' or 'deliver'"),
        ({"kind": "udp", "mss": 1000}, "Extra inputs"),
        ({"kind": "tcp", "congestion": "bbr"}, "'cubic' or 'reno'"),
        ({"kind": "tcp", "mss": 2000, "buffer_bytes": 1999}, "got 1999; allowed: at least mss, which is 2000"),
        ({"kind": "tcp", "lease": "0 s"}, "allowed"),
        ({"kind": "sctp"}, "'udp', 'tcp'"),
    ],
)
def test_wrong_settings_are_refused(keys: dict[str, Any], problem: str) -> None:
    with pytest.raises(ValidationError, match=problem):
        ADAPTER.validate_python(keys)
