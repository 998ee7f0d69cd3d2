"""One capture whose packets carry numbers, or two: what is missing was lost. And ICMP echo: requests and replies."""

from __future__ import annotations

import re
from collections import defaultdict
from collections.abc import Iterable
from dataclasses import dataclass

from testbed.channel.capture.datagrams import Datagram
from testbed.channel.capture.flows import Read
from testbed.channel.capture.imported import PACKETS_MAX, Imported, Unwrapped, counted, interpolated, rows_of
from testbed.errors import UsageError

_RTP_VERSION = 2


@dataclass(frozen=True)
class Numbering:
    """Where the payload of a packet has its number: so many bytes from an offset, most significant first or last."""

    offset: int
    size: int
    little: bool = False
    rtp: bool = False

    @classmethod
    def parse(cls, text: str) -> Numbering:
        """From OFFSET:BYTES or OFFSET:BYTES:little. Raises UsageError."""
        match = re.fullmatch(r"(\d{1,5}):(\d)(?::(little|big))?", text, re.ASCII)
        if match is None or not 1 <= int(match[2]) <= 8:
            raise UsageError(
                f"--sequence: got {text[:60]!r}; allowed: OFFSET:BYTES with 1 … 8 bytes, such as 0:4, or 0:4:little"
            )
        return cls(int(match[1]), int(match[2]), match[3] == "little")

    def of(self, packet: Datagram) -> int | None:
        """None where the payload is too short, or is no RTP where it should be."""
        payload = packet.payload
        if len(payload) < self.offset + self.size:
            return None
        if self.rtp and (len(payload) < 12 or payload[0] >> 6 != _RTP_VERSION):
            return None
        return int.from_bytes(payload[self.offset : self.offset + self.size], "little" if self.little else "big")


RTP = Numbering(2, 2, rtp=True)
"""H. Schulzrinne et al.: RTP. RFC 3550, section 5.1."""


def received(read: Read, numbering: Numbering) -> Imported:
    """From the receiver's capture alone: which numbers are missing, and in which order the others came."""
    read.only_flow()
    arrivals = _numbered(read, numbering, str(read.path))
    first, last = min(arrivals), max(arrivals)
    known = {seq: times[0] for seq, times in arrivals.items()}
    sent = interpolated(known, first, last)
    rows = rows_of(sent, [arrivals.get(seq, []) for seq in range(first, last + 1)])
    return Imported(
        rows,
        "one way",
        counted(read.left_out),
        [
            "one capture at the receiver tells no delays: sent_ns is the time of arrival, that of a lost packet lies "
            "between those of its neighbours",
            "what was lost before the first or after the last packet cannot be told",
        ],
    )


def matched(sender: Read, receiver: Read, numbering: Numbering) -> Imported:
    """From two captures, by the numbers: fates and one-way delays of all packets in the sender's."""
    for read in (sender, receiver):
        read.only_flow()
    starts = _numbered(sender, numbering, str(sender.path))
    size = 1 << 8 * numbering.size
    arrivals: defaultdict[int, list[int]] = defaultdict(list)
    for seq, times in _numbered(receiver, numbering, str(receiver.path), near=next(iter(starts))).items():
        arrivals[seq] += times
    met = sorted(seq for seq in starts if seq in arrivals)
    if not met:
        raise UsageError(
            f"{sender.path}, {receiver.path}: got no number below {size} that is in both; allowed: captures of one flow"
        )
    inner = [seq for seq in sorted(starts) if met[0] <= seq <= met[-1]]
    left_out = sender.left_out + receiver.left_out
    if left := len(starts) - len(inner):
        left_out["before the first or after the last number in both"] += left
    if strange := sum(seq not in starts for seq in arrivals):
        left_out["received, but not in the sender's capture"] += strange
    rows = rows_of([starts[seq][0] for seq in inner], [arrivals.get(seq, []) for seq in inner])
    least = min(at - starts[seq][0] for seq in met for at in arrivals[seq])
    return Imported(
        rows,
        "one way",
        counted(left_out),
        [f"delays include the offset between the clocks of the two captures; the least is {least / 1e6:.3f} ms"],
    )


def echoes(read: Read) -> Imported | None:
    """Requests and replies of ICMP echo: a round trip each. None where there are none.

    Raises UsageError where several hosts were asked, or by several programs.
    """
    pings = [packet for packet in read.packets if packet.echo]
    if not any(packet.echo == "request" for packet in pings):
        return None
    if others := len(read.packets) - len(pings):
        read.left_out["not ICMP echo"] += others
    requests = [packet for packet in pings if packet.echo == "request"]
    flows = {(packet.source, packet.destination, packet.ports[0]) for packet in requests}
    if len(flows) > 1:
        shown = "; ".join(f"{a} → {b} identifier {number}" for a, b, number in sorted(flows)[:4])
        raise UsageError(f"{read.path}: got {len(flows)} series of pings: {shown}; allowed: one; --from, --to")
    ((source, destination, identifier),) = flows
    where = Unwrapped(16, str(read.path))
    sent: dict[int, int] = {}
    arrivals: defaultdict[int, list[int]] = defaultdict(list)
    for packet in pings:
        back = (packet.destination, packet.source, packet.ports[0])
        if packet.echo == "request":
            sent.setdefault(where.next(packet.sequence), packet.at_ns)
        elif back == (source, destination, identifier) and sent:
            seq = where.next(packet.sequence)
            if seq in sent:
                arrivals[seq].append(packet.at_ns)
            else:
                read.left_out["replies without a request"] += 1
        else:
            read.left_out["replies without a request"] += 1
    numbers = sorted(sent)
    rows = rows_of([sent[seq] for seq in numbers], [arrivals.get(seq, []) for seq in numbers])
    notes = ["a lost packet is a request or its reply", *_missing(numbers)]
    return Imported(rows, "round trip", counted(read.left_out), notes)


def _missing(numbers: list[int]) -> Iterable[str]:
    if missing := numbers[-1] - numbers[0] + 1 - len(numbers):
        yield f"{missing} requests are not in the capture; they are left out"


def _numbered(read: Read, numbering: Numbering, where: str, near: int | None = None) -> dict[int, list[int]]:
    """Times by number. near: the first number is taken as close to it as can be."""
    unwrapped = Unwrapped(8 * numbering.size, where)
    if near is not None:
        unwrapped.next(near)
    times: defaultdict[int, list[int]] = defaultdict(list)
    for packet in read.packets:
        number = numbering.of(packet)
        if number is None:
            read.left_out["without a number"] += 1
            continue
        times[unwrapped.next(number)].append(packet.at_ns)
    if not times:
        raise UsageError(f"{where}: got no packet with a number at that place; allowed: one or more")
    if len(times) == 1 < len(next(iter(times.values()))):
        raise UsageError(f"{where}: got the number {next(iter(times))} in every packet; allowed: one that counts them")
    if max(times) - min(times) >= PACKETS_MAX:
        raise UsageError(f"{where}: got numbers {min(times)} … {max(times)}; allowed: fewer than {PACKETS_MAX} apart")
    return dict(times)
