"""The datagrams of a capture file that a user asked for, and what was left out."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, field
from ipaddress import ip_address
from pathlib import Path

from testbed.channel.capture.datagrams import Datagram, datagram_of
from testbed.channel.capture.frames import Capture
from testbed.channel.capture.imported import PACKETS_MAX
from testbed.errors import UsageError

_FLOWS_SHOWN = 4


@dataclass(frozen=True)
class Filter:
    """Which datagrams: those with all that is given, and replies to such echo requests."""

    protocol: str | None = None
    source: str | None = None
    destination: str | None = None
    source_port: int | None = None
    destination_port: int | None = None

    def __post_init__(self) -> None:
        for option, text in (("--from", self.source), ("--to", self.destination)):
            if text is not None:
                try:
                    ip_address(text)
                except ValueError:
                    raise UsageError(f"{option}: got {text[:60]!r}; allowed: an IPv4 or IPv6 address") from None

    def takes(self, packet: Datagram) -> bool:
        ends = packet.source, packet.destination
        source, destination = reversed(ends) if packet.echo == "reply" else ends
        return (
            self.protocol in (None, packet.protocol)
            and self.source_port in (None, packet.ports[0])
            and self.destination_port in (None, packet.ports[1])
            and (self.source is None or ip_address(self.source) == ip_address(source))
            and (self.destination is None or ip_address(self.destination) == ip_address(destination))
        )


@dataclass(frozen=True)
class Read:
    """What was taken from a file. left_out: frames by reason."""

    path: Path
    packets: list[Datagram]
    left_out: Counter[str] = field(default_factory=Counter)

    def only_flow(self) -> None:
        """Raises UsageError where there is more than one flow, or none."""
        flows = Counter(packet.flow for packet in self.packets)
        if not flows:
            why = ", ".join(f"{count} {reason}" for reason, count in self.left_out.most_common())
            raise UsageError(f"{self.path}: got no packet to use ({why or 'an empty capture'}); allowed: one or more")
        if len(flows) > 1:
            names = "; ".join(f"{flow} ({count})" for flow, count in flows.most_common(_FLOWS_SHOWN))
            more = "; …" if len(flows) > _FLOWS_SHOWN else ""
            raise UsageError(
                f"{self.path}: got {len(flows)} flows: {names}{more}; allowed: one; "
                "choose it with --protocol, --from, --to, --from-port, --to-port"
            )


def read_capture(path: Path, wanted: Filter) -> Read:
    """Raises UsageError where the file cannot be read or is no capture."""
    read = Read(path, [])
    try:
        with path.open("rb") as file:
            capture = Capture(file, str(path))
            for frame in capture:
                packet = datagram_of(frame)
                if isinstance(packet, str):
                    read.left_out[packet] += 1
                elif not wanted.takes(packet):
                    read.left_out["not asked for"] += 1
                elif len(read.packets) == PACKETS_MAX:
                    raise UsageError(f"{path}: got more than {PACKETS_MAX} packets; allowed: that many")
                else:
                    read.packets.append(packet)
    except OSError as error:
        raise UsageError(f"cannot read {path}: {(error.strerror or str(error)).lower()}") from None
    if capture.untimed:
        read.left_out["without a time"] += capture.untimed
    if capture.cut:
        read.left_out["cut off at the end of the file"] += 1
    return read
