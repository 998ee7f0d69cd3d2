"""What stands between the two ends of a link: a relay, or the kernel with two hosts."""

from __future__ import annotations

import socket
import subprocess
from collections.abc import Callable
from typing import Any, Protocol

from testbed.channel.kernel.hosts import MTU_MIN, Hosts, Way
from testbed.channel.sockets.link import DIRECTIONS, SocketLink
from testbed.channel.sockets.tcp_proxy import TcpProxy
from testbed.channel.sockets.udp_relay import UdpRelay
from testbed.scenario.carriers import TcpTransport, UdpTransport
from testbed.scenario.links import Impairments, SteppedImpairments

Popen = Callable[..., subprocess.Popen[Any]]

_PORT = 7447
_MTU = 1500
RECEIVER, SENDER = "receiving end", "sending end"
_IDLE_NS = 5_000_000_000
"""A sender that was silent for so long gives its place to another one, such as itself with another port."""


class Middle(Protocol):
    """Carries packets both ways while in ``with``, at first without impairments."""

    def __enter__(self) -> object: ...

    def __exit__(self, *_: object) -> None: ...

    def listen(self) -> str:
        """The endpoint for the receiving end; another one each time, where there are several."""
        ...

    def connect(self) -> str:
        """The endpoint for the sending end, once the receiving one listens."""
        ...

    def popen(self, end: str) -> Popen:
        """What starts the RECEIVER or the SENDER."""
        ...

    def begin(self, settings: SteppedImpairments) -> None:
        """The ends hear each other: nobody else is let in, and packet 0 comes next, with impairments.

        But over a TCP proxy, which loses nothing, packets are numbered from the start. Raises TestbedError.
        """
        ...

    def change(self, settings: SteppedImpairments) -> None:
        """Other impairments from now on. Raises TestbedError."""
        ...

    def books(self) -> dict[str, dict[str, int]]:
        """Of packets: "forward", "backward". Raises TestbedError."""
        ...


def middle_of(settings: SteppedImpairments, seed: int, component: str) -> Middle:
    """component: whose streams the draws of the forward direction are."""
    made = KernelMiddle if settings.backend == "kernel" else RelayMiddle
    return made(settings, seed, component)


def directions(settings: SteppedImpairments) -> tuple[Impairments, Impairments]:
    """What happens to the packets forwards and backwards.

    Backwards over UDP goes nothing but zenoh's own packets: they take the same time, and none is lost. Over TCP
    it is the acknowledgements, and they meet what the key ``back`` says, as in the model.
    """
    if isinstance(settings.transport, TcpTransport):
        return settings, settings.backwards
    return settings, Impairments(delay=settings.delay)


def components(component: str) -> tuple[str, str]:
    return component, f"{component}.back"


def scheme_of(settings: SteppedImpairments) -> str:
    """The kind of zenoh endpoints."""
    return "tcp" if isinstance(settings.transport, TcpTransport) else "udp"


class RelayMiddle:
    """A UDP relay, or a TCP proxy, on loopback; no rights needed."""

    def __init__(self, settings: SteppedImpairments, seed: int, component: str) -> None:
        self._scheme, self._seed, self._components = scheme_of(settings), seed, components(component)
        self._target = ("127.0.0.1", 0)
        self._link: SocketLink | None = None

    def __enter__(self) -> RelayMiddle:
        return self

    def __exit__(self, *_: object) -> None:
        if self._link is not None:
            self._link.close()

    def listen(self) -> str:
        with socket.socket(type=socket.SOCK_DGRAM if self._scheme == "udp" else socket.SOCK_STREAM) as probe:
            probe.bind(("127.0.0.1", 0))
            self._target = probe.getsockname()
        return f"{self._scheme}/127.0.0.1:{self._target[1]}"

    def connect(self) -> str:
        link: SocketLink
        if self._scheme == "udp":
            link = UdpRelay(
                self._target,
                seed=self._seed,
                components=self._components,
                idle_ns=_IDLE_NS,
                checksummed=True,
            )
        else:
            link = TcpProxy(self._target, seed=self._seed, components=self._components)
        self._link = link.__enter__()
        return f"{self._scheme}/127.0.0.1:{link.address[1]}"

    def popen(self, end: str) -> Popen:
        return subprocess.Popen

    def begin(self, settings: SteppedImpairments) -> None:
        link = self._running()
        if isinstance(link, UdpRelay):
            link.limit_clients(1)
            link.begin(*directions(settings))
        else:
            self.change(settings)

    def change(self, settings: SteppedImpairments) -> None:
        link = self._running()
        for direction, impairments in zip(DIRECTIONS, directions(settings), strict=True):
            link.change(direction, impairments)

    def books(self) -> dict[str, dict[str, int]]:
        link = self._running()
        link.wait(0.0)
        figures = link.figures()
        return {**figures.directions, "relay": figures.around}

    def _running(self) -> SocketLink:
        assert self._link is not None
        return self._link


class KernelMiddle:
    """Two hosts, the sending end in a and the receiving end in b."""

    def __init__(self, settings: SteppedImpairments, seed: int, component: str) -> None:
        transport = settings.transport
        forward, backward = (Way(Impairments(), name) for name in components(component))
        self._scheme = scheme_of(settings)
        self._hosts = Hosts(
            forward,
            backward,
            seed=seed,
            congestion=transport.congestion if isinstance(transport, TcpTransport) else None,
            mtu=max(MTU_MIN, transport.mtu) if isinstance(transport, UdpTransport) else _MTU,
        )

    def __enter__(self) -> KernelMiddle:
        self._hosts.__enter__()
        return self

    def __exit__(self, *_: object) -> None:
        self._hosts.__exit__(None, None, None)

    def listen(self) -> str:
        return f"{self._scheme}/{self._hosts.b.address}:{_PORT}"

    def connect(self) -> str:
        return self.listen()

    def popen(self, end: str) -> Popen:
        return (self._hosts.b if end == RECEIVER else self._hosts.a).popen

    def begin(self, settings: SteppedImpairments) -> None:
        self._hosts.begin(*directions(settings))

    def change(self, settings: SteppedImpairments) -> None:
        for direction, impairments in zip(DIRECTIONS, directions(settings), strict=True):
            self._hosts.change(direction, impairments)

    def books(self) -> dict[str, dict[str, int]]:
        return self._hosts.books()
