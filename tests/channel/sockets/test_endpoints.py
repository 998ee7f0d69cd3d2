"""Endpoints in zenoh's form."""

from __future__ import annotations

import socket

import pytest

from channel.sockets.ends import PATIENCE_S
from testbed.channel.sockets.endpoints import Endpoint, endpoint
from testbed.channel.sockets.udp_relay import UdpRelay
from testbed.errors import UsageError


@pytest.mark.parametrize(
    ("text", "expected", "loopback"),
    [
        ("udp/127.0.0.1:7447", Endpoint("udp", "127.0.0.1", 7447), True),
        ("tcp/[::1]:0", Endpoint("tcp", "::1", 0), True),
        ("tcp/localhost:65535", Endpoint("tcp", "localhost", 65535), True),
        ("udp/0.0.0.0:1", Endpoint("udp", "0.0.0.0", 1), False),
        ("udp/host.example:1", Endpoint("udp", "host.example", 1), False),
    ],
)
def test_an_endpoint_is_read_and_written(text, expected, loopback):
    assert endpoint(text, "--to") == expected
    assert str(expected) == text
    assert expected.loopback is loopback


@pytest.mark.parametrize(
    "text", ["", "udp", "udp/1.2.3.4", "udp/::1:7", "udp/h:65536", "udp/h:-1", "tls/h:1", "udp/h:1?x"]
)
def test_what_is_no_endpoint_is_refused(text):
    with pytest.raises(UsageError, match=r"^--to .*allowed: udp/HOST:PORT or tcp/HOST:PORT"):
        endpoint(text, "--to")


def test_an_unknown_host_is_refused():
    with pytest.raises(UsageError, match="cannot resolve the host"):
        Endpoint("udp", "no.such.host.invalid", 1).resolve()


def test_the_relay_speaks_ipv6():
    try:
        target = socket.socket(socket.AF_INET6, socket.SOCK_DGRAM)
        target.bind(("::1", 0))
    except OSError:
        pytest.skip("no IPv6 here")
    with target, UdpRelay(target.getsockname()[:2], listen=("::1", 0)) as relay:
        target.settimeout(PATIENCE_S)
        with socket.socket(socket.AF_INET6, socket.SOCK_DGRAM) as client:
            client.settimeout(PATIENCE_S)
            client.connect(relay.address)
            client.send(b"there")
            data, seen_as = target.recvfrom(100)
            target.sendto(b"and back", seen_as)
            assert (data, client.recv(100)) == (b"there", b"and back")
