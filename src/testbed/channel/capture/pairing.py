"""Two captures of the same packets, one where they were sent and one where they arrive: fates and one-way delays."""

from __future__ import annotations

from collections import Counter, defaultdict
from hashlib import blake2b
from typing import Literal

from testbed.channel.capture.datagrams import Datagram
from testbed.channel.capture.flows import Read
from testbed.channel.capture.imported import Imported, counted, rows_of
from testbed.errors import UsageError

Match = Literal["packet", "payload"]
"""packet: addresses, ports, IP identification, TCP sequence number and payload; payload: that alone, where a relay or
an address translation stands between the two."""


def paired(sender: Read, receiver: Read, match: Match = "packet") -> Imported:
    """The fate of each packet of the sender's capture, from the first to the last that the receiver's has too.

    Raises UsageError where nothing matches, or packets cannot be told apart.
    """
    for read in (sender, receiver):
        read.only_flow()
    left_out = Counter[str]()
    for name, read in (("sender", sender), ("receiver", receiver)):
        left_out.update({f"{name}: {reason}": count for reason, count in read.left_out.items()})
    kept = min((len(p.payload) for r in (sender, receiver) for p in r.packets if not p.whole), default=None)
    sent = [(packet.at_ns, _key(packet, match, kept)) for packet in sender.packets]
    arrived: defaultdict[bytes, list[int]] = defaultdict(list)
    for packet in receiver.packets:
        arrived[_key(packet, match, kept)].append(packet.at_ns)
    twins = {key: count for key, count in Counter(key for _, key in sent).items() if count > 1}
    lost_twins = sum(count for key, count in twins.items() if len(arrived[key]) != count)
    if lost_twins:
        raise UsageError(
            f"{sender.path}, {receiver.path}: got {lost_twins} packets that look the same as others, some of which "
            "are missing; allowed: packets that differ, or a number in them (--sequence OFFSET:BYTES)"
        )
    copies = [[arrived[key].pop(0)] if key in twins else arrived.pop(key, []) for _, key in sent]
    met = [index for index, times in enumerate(copies) if times]
    if not met:
        raise UsageError(
            f"{sender.path}, {receiver.path}: got no packet that is in both; allowed: captures of one flow at the same "
            "time; --match payload where addresses or ports are changed on the way"
        )
    first, last = met[0], met[-1]
    if left := first + len(sent) - 1 - last:
        left_out["sender: before the first or after the last packet in both"] += left
    if strange := sum(len(times) for times in arrived.values()):
        left_out["receiver: not in the sender's capture"] += strange
    rows = rows_of([at for at, _ in sent[first : last + 1]], copies[first : last + 1])
    least = min(at - start for (start, _), times in zip(sent, copies, strict=True) for at in times)
    return Imported(
        rows,
        "one way",
        counted(left_out),
        [f"delays include the offset between the clocks of the two captures; the least is {least / 1e6:.3f} ms"],
    )


def _key(packet: Datagram, match: Match, kept: int | None) -> bytes:
    payload = blake2b(packet.payload[:kept], digest_size=16).digest()
    if match == "payload":
        return payload
    number = packet.sequence if packet.protocol != "udp" else 0
    rest = (packet.source, packet.destination, packet.ports, packet.identification, packet.echo, number)
    return repr(rest).encode() + payload
