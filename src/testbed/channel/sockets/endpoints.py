"""Endpoints in zenoh's form: ``udp/127.0.0.1:7447``, ``tcp/[::1]:7447``."""

from __future__ import annotations

import ipaddress
import re
import socket
from dataclasses import dataclass
from typing import Any

from testbed.errors import UsageError, did_you_mean

SCHEMES = ("udp", "tcp")
_FORM = re.compile(r"(?P<scheme>[^/]+)/(?:\[(?P<six>[^\[\]]+)\]|(?P<host>[^:\[\]]+)):(?P<port>\d{1,5})")
_KINDS = {"udp": socket.SOCK_DGRAM, "tcp": socket.SOCK_STREAM}


@dataclass(frozen=True)
class Endpoint:
    """A scheme, a host by name or number, and a port; 0 where any free one will do."""

    scheme: str
    host: str
    port: int

    def __str__(self) -> str:
        host = f"[{self.host}]" if ":" in self.host else self.host
        return f"{self.scheme}/{host}:{self.port}"

    @property
    def loopback(self) -> bool:
        """Whether only this machine reaches it."""
        try:
            return ipaddress.ip_address(self.host).is_loopback
        except ValueError:
            return self.host == "localhost"

    def resolve(self) -> tuple[socket.AddressFamily, Any]:
        """Family and address as sockets take them. Raises UsageError for an unknown host."""
        try:
            found = socket.getaddrinfo(self.host, self.port, type=_KINDS[self.scheme])
        except (OSError, UnicodeError) as error:
            reason = getattr(error, "strerror", None) or error
            raise UsageError(f"{self}: cannot resolve the host: {str(reason).lower()}") from None
        return found[0][0], found[0][4]


def endpoint(text: str, option: str) -> Endpoint:
    """Read an endpoint. Raises UsageError, which names the option that it was given for."""
    allowed = "allowed: udp/HOST:PORT or tcp/HOST:PORT, such as udp/127.0.0.1:7447"
    match = _FORM.fullmatch(text)
    if match is None or int(match["port"]) > 65535:
        raise UsageError(f"{option} {text}: not an endpoint; {allowed}")
    if match["scheme"] not in SCHEMES:
        raise UsageError(f"{option} {text}: got {match['scheme']!r}; {allowed}{did_you_mean(match['scheme'], SCHEMES)}")
    return Endpoint(match["scheme"], match["six"] or match["host"], int(match["port"]))
