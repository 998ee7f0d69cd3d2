"""Logs of ping of several systems: numbers, losses, copies and times; the same trace whichever wrote them."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from testbed.channel.capture.imported import Imported
from testbed.channel.capture.ping import ping_log
from testbed.errors import UsageError

MS, SECOND = 10**6, 10**9

IPUTILS = """PING 10.0.0.2 (10.0.0.2) 56(84) bytes of data.
64 bytes from 10.0.0.2: icmp_seq=1 ttl=64 time=12.5 ms
64 bytes from 10.0.0.2: icmp_seq=3 ttl=64 time=0.034 ms
64 bytes from 10.0.0.2: icmp_seq=3 ttl=64 time=0.051 ms (DUP!)
From 10.0.0.1 icmp_seq=4 Destination Host Unreachable
64 bytes from host.example (10.0.0.2): icmp_seq=6 ttl=64 time=2001 ms

--- 10.0.0.2 ping statistics ---
8 packets transmitted, 3 received, +1 duplicates, 62.5% packet loss, time 7011ms
rtt min/avg/max/mdev = 0.034/671.178/2001.000/942.0 ms, pipe 3
"""
BUSYBOX = """PING 10.0.0.2 (10.0.0.2): 56 data bytes
64 bytes from 10.0.0.2: seq=0 ttl=64 time=12.500 ms
64 bytes from 10.0.0.2: seq=2 ttl=64 time=0.034 ms
64 bytes from 10.0.0.2: seq=2 ttl=64 time=0.051 ms (DUP!)
64 bytes from 10.0.0.2: seq=5 ttl=64 time=2001.000 ms

--- 10.0.0.2 ping statistics ---
8 packets transmitted, 3 packets received, 1 duplicates, 62% packet loss
round-trip min/avg/max = 0.034/671.178/2001.000 ms
"""
MACOS = """PING 10.0.0.2 (10.0.0.2): 56 data bytes
64 bytes from 10.0.0.2: icmp_seq=0 ttl=64 time=12.500 ms
Request timeout for icmp_seq 1
64 bytes from 10.0.0.2: icmp_seq=2 ttl=64 time=0.034 ms
64 bytes from 10.0.0.2: icmp_seq=2 ttl=64 time=0.051 ms (DUP!)
Request timeout for icmp_seq 3
Request timeout for icmp_seq 4
Request timeout for icmp_seq 5
64 bytes from 10.0.0.2: icmp_seq=5 ttl=64 time=2001.000 ms
Request timeout for icmp_seq 6

--- 10.0.0.2 ping statistics ---
8 packets transmitted, 3 packets received, +1 duplicates, 62.5% packet loss
round-trip min/avg/max/stddev = 0.034/671.178/2001.000/942.0 ms
"""
ROWS = {
    (0, 0, 12_500_000),
    (1, SECOND, None),
    (2, 2 * SECOND, 2 * SECOND + 34_000),
    (2, 2 * SECOND, 2 * SECOND + 51_000),
    (3, 3 * SECOND, None),
    (4, 4 * SECOND, None),
    (5, 5 * SECOND, 7 * SECOND + MS),
    (6, 6 * SECOND, None),
    (7, 7 * SECOND, None),
}
NO_TIMES = "the lines have no times: packets are taken to be sent every 1 s, ping's default"


def imported(text: str, interval_ns: int | None = None) -> Imported:
    return ping_log(text.splitlines(), "ping.log", interval_ns)


@pytest.mark.parametrize("text", [IPUTILS, BUSYBOX, MACOS], ids=["iputils", "busybox", "macos"])
def test_logs_without_times(text: str) -> None:
    found = imported(text)
    assert set(found.rows) == ROWS
    assert (found.measures, found.left_out) == ("round trip", {})
    assert found.notes == ["a lost packet is a request or its reply", NO_TIMES]


def test_the_interval_that_was_used() -> None:
    found = imported(IPUTILS, interval_ns=10 * MS)
    assert {(seq, sent) for seq, sent, _ in found.rows} == {(k, 10 * k * MS) for k in range(8)}
    assert "sent every 10 ms" in found.notes[1]


def test_a_log_with_times() -> None:
    """ping -D -O: the time of a line is that of the reply; lost packets lie between their neighbours."""
    text = """PING 10.0.0.2 (10.0.0.2) 56(84) bytes of data.
[1700000000.012500] 64 bytes from 10.0.0.2: icmp_seq=1 ttl=64 time=12.5 ms
[1700000001.000099] no answer yet for icmp_seq=2
[1700000000.400007] 64 bytes from 10.0.0.2: icmp_seq=3 ttl=64 time=0.007 ms
[1700000000.900000] 64 bytes from 10.0.0.2: icmp_seq=5 ttl=64 time=100 ms
^C
something else
"""
    found = imported(text)
    start = 1_700_000_000 * SECOND
    assert found.rows == [
        (0, start, start + 12_500_000),
        (1, start + 200 * MS, None),
        (2, start + 400 * MS, start + 400_007_000),
        (3, start + 600 * MS, None),
        (4, start + 800 * MS, start + 900 * MS),
    ]
    assert found.left_out == {"not of ping": 2}
    assert found.notes[1:] == ["no summary: what was lost before the first or after the last line cannot be told"]


def test_a_late_reply_to_a_packet_called_lost() -> None:
    text = "no answer yet for icmp_seq=1\n64 bytes from 1.1.1.1: icmp_seq=1 ttl=1 time=1500 ms"
    assert imported(text).rows == [(0, 0, 1500 * MS)]


def test_windows() -> None:
    text = """
Pinging 10.0.0.2 with 32 bytes of data:
Reply from 10.0.0.2: bytes=32 time=14ms TTL=57
Request timed out.
Reply from 10.0.0.2: bytes=32 time<1ms TTL=57
Reply from 10.0.0.1: Destination host unreachable.
General failure.

Ping statistics for 10.0.0.2:
    Packets: Sent = 5, Received = 2, Lost = 3 (60% loss),
Approximate round trip times in milli-seconds:
    Minimum = 0ms, Maximum = 14ms, Average = 7ms
"""
    found = imported(text)
    assert [(seq, at is not None) for seq, _, at in sorted(found.rows)] == [
        (0, True),
        (1, False),
        (2, True),
        (3, False),
        (4, False),
    ]
    assert found.left_out == {}


def test_numbers_that_wrap() -> None:
    lines = [f"64 bytes from ::1: icmp_seq={seq % 65536} ttl=64 time=1 ms" for seq in range(65_530, 65_550) if seq % 7]
    rows = ping_log(lines, "x").rows
    first = 65_530
    assert len(rows) == 20
    assert {seq for seq, _, at in rows if at is None} == {seq - first for seq in range(65_530, 65_550) if not seq % 7}


@pytest.mark.parametrize("text", ["", "hello\n", "8 packets transmitted, 0 received, 100% packet loss", "\0\0"])
def test_no_reply_is_a_line(text: str) -> None:
    with pytest.raises(UsageError, match=r"^ping\.log: got no reply of a ping; allowed: ") as raised:
        imported(text)
    assert "\n" not in str(raised.value)


def test_a_sum_that_cannot_be() -> None:
    with pytest.raises(UsageError, match=r"got numbers 1 … 999999999; allowed: fewer than 5000000 apart"):
        imported("64 bytes from ::1: icmp_seq=1 time=1 ms\n999999999 packets transmitted, 1 received")


@given(st.lists(st.sampled_from([*IPUTILS.splitlines(), *MACOS.splitlines(), "Request timed out.", "[1] x", ""])))
def test_no_mixture_of_lines_raises(lines: list[str]) -> None:
    if any("bytes from" in line for line in lines):
        assert ping_log(lines, "x").rows
