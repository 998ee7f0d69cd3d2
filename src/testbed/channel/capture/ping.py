"""The log of a ping as a trace of round trips: iputils (plain, -D, -O), BusyBox, macOS and BSD, Windows.

A line is a reply, a loss, the summary, or something else, which is counted. Where lines have numbers (icmp_seq) a
number without a reply was lost; on Windows, which prints none, each line of a reply or a loss is the next packet.
"""

from __future__ import annotations

import re
from collections import Counter, defaultdict
from collections.abc import Iterable
from dataclasses import dataclass, field
from decimal import Decimal

from testbed.channel.capture.imported import PACKETS_MAX, Imported, Unwrapped, counted, interpolated, rows_of
from testbed.errors import UsageError

_NUMBER = r"(\d{1,12}(?:\.\d{1,9})?)"
_STAMP = re.compile(rf"^\[{_NUMBER}\]\s*", re.ASCII)
_REPLY = re.compile(rf"\bbytes from .*?\b(?:icmp_)?seq[=\s](\d{{1,9}})\b.*?\btime[=<\s]\s*{_NUMBER}\s*ms", re.ASCII)
_WINDOWS_REPLY = re.compile(rf"^Reply from \S+: (?:bytes=\d+ )?time[=<]{_NUMBER}\s*ms", re.ASCII)
_LOST = re.compile(r"^(?:no answer yet for|Request timeout for) icmp_seq[=\s](\d{1,9})", re.ASCII)
_UNREACHABLE = re.compile(r"^From .*\bicmp_seq=(\d{1,9})\b", re.ASCII)
_WINDOWS_LOST = re.compile(
    r"^(?:Request timed out|Reply from \S+: .*(?:unreachable|expired)|General failure|PING: transmit failed)", re.ASCII
)
_TRANSMITTED = re.compile(r"^(\d{1,9}) packets transmitted, (?:\d+) (packets )?received", re.ASCII)
_HEADINGS = (
    *("PING ", "--- ", "rtt ", "round-trip "),
    *("Pinging ", "Ping statistics", "Packets: ", "Approximate round trip", "Minimum = "),
)
_BITS = 16


@dataclass
class _Log:
    """What the lines said. Times of replies are known where each line has one, as with -D."""

    round_trips: defaultdict[int, list[tuple[int, int | None]]] = field(default_factory=lambda: defaultdict(list))
    lost: set[int] = field(default_factory=set)
    left_out: Counter[str] = field(default_factory=Counter)
    next_line: int = 0
    transmitted: int | None = None
    first: int = 0


def ping_log(lines: Iterable[str], name: str, interval_ns: int | None = None) -> Imported:
    """The trace of a log. interval_ns: between packets, where the lines have no time; default one second.

    Raises UsageError where there is no reply in it, or where numbers jump.
    """
    log, unwrapped = _Log(), Unwrapped(_BITS, name)
    for line in lines:
        _take(line.strip(), log, unwrapped)
    numbers = {*log.round_trips, *log.lost}
    if not log.round_trips:
        raise UsageError(f"{name}: got no reply of a ping; allowed: a log with a line for each reply, or a capture")
    first, last = min(numbers), max(numbers)
    if log.transmitted is not None:
        first = min(first, log.first)
        last = max(last, first + log.transmitted - 1)
    if last - first >= PACKETS_MAX:
        raise UsageError(f"{name}: got numbers {first} … {last}; allowed: fewer than {PACKETS_MAX} apart")
    sent, stamped = _sent(log, first, last, interval_ns)
    arrivals = [
        [sent[seq - first] + trip for trip, _ in log.round_trips.get(seq, [])] for seq in range(first, last + 1)
    ]
    return Imported(
        rows_of(sent, arrivals), "round trip", counted(log.left_out), list(_notes(log, stamped, interval_ns))
    )


def _take(line: str, log: _Log, unwrapped: Unwrapped) -> None:
    stamp = _STAMP.match(line)
    at_ns = _ns(stamp[1], 9) if stamp else None
    line = line[stamp.end() :] if stamp else line
    if not line:
        return
    if reply := _REPLY.search(line):
        log.round_trips[unwrapped.next(int(reply[1]))].append((_ns(reply[2], 6), at_ns))
    elif reply := _WINDOWS_REPLY.match(line):
        log.round_trips[log.next_line].append((_ns(reply[1], 6), None))
        log.next_line += 1
    elif found := _LOST.match(line) or _UNREACHABLE.match(line):
        log.lost.add(unwrapped.next(int(found[1])))
    elif _WINDOWS_LOST.match(line):
        log.lost.add(log.next_line)
        log.next_line += 1
    elif found := _TRANSMITTED.match(line):
        log.transmitted, log.first = int(found[1]), 0 if found[2] else 1
    elif not line.startswith(_HEADINGS):
        log.left_out["not of ping"] += 1


def _sent(log: _Log, first: int, last: int, interval_ns: int | None) -> tuple[list[int], bool]:
    """When each packet was sent, and whether that comes from the times of the lines."""
    known = {}
    for seq, trips in log.round_trips.items():
        trip, at = trips[0]
        if at is not None:
            known[seq] = at - trip
    if len(known) > 1 or (known and first == last):
        return interpolated(known, first, last), True
    step = 10**9 if interval_ns is None else interval_ns
    return [number * step for number in range(last - first + 1)], False


def _notes(log: _Log, stamped: bool, interval_ns: int | None) -> Iterable[str]:
    yield "a lost packet is a request or its reply"
    if not stamped:
        every = "1 s, ping's default" if interval_ns is None else f"{interval_ns / 1e6:g} ms"
        yield f"the lines have no times: packets are taken to be sent every {every}"
    if log.transmitted is None:
        yield "no summary: what was lost before the first or after the last line cannot be told"


def _ns(text: str, digits: int) -> int:
    """A number with units of 10^digits ns."""
    return int(Decimal(text) * 10**digits)
