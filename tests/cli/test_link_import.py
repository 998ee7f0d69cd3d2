"""``testbed link import`` and ``testbed link presets``: files, JSON, and errors in one line."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from channel.capture import build
from channel.capture.build import MS, Taken
from cli.commands import Command, testbed
from testbed.scenario.presets import presets
from testbed.scenario.trace_file import read_rows

__all__ = ["testbed"]

PING = "\n".join(f"64 bytes from ::1: icmp_seq={k} ttl=64 time={k} ms" for k in (1, 2, 4)) + "\nwhat\n"


def test_a_ping_log_becomes_a_trace_that_can_be_used(testbed: Command, tmp_path: Path) -> None:
    (tmp_path / "ping.log").write_text(PING)
    given = testbed("link", "import", "ping.log", "--out", "t.csv", "--interval", "20 ms")
    assert (given.code, given.err) == (0, "")
    assert given.out.splitlines() == [
        "ping.log: round trip, 4 sent, 1 lost, loss rate 0.25, 0 duplicates; t.csv",
        "left out: 1 not of ping",
        "note: a lost packet is a request or its reply",
        "note: the lines have no times: packets are taken to be sent every 20 ms",
        "note: no summary: what was lost before the first or after the last line cannot be told",
    ]
    assert (tmp_path / "t.csv").read_text() == (
        f"seq,sent_ns,delivered_ns\n0,0,{MS}\n1,{20 * MS},{22 * MS}\n2,{40 * MS},\n3,{60 * MS},{64 * MS}\n"
    )
    figures = json.loads(testbed("link", "import", "ping.log", "--out", "t.csv", "--json").out)
    assert (figures["sent"], figures["dropped"], figures["left_out"]) == (4, 1, {"not of ping": 1})


@pytest.mark.parametrize("encoding", ["utf-8-sig", "utf-16"])
def test_a_log_as_windows_writes_it(testbed: Command, tmp_path: Path, encoding: str) -> None:
    text = "Reply from 10.0.0.2: bytes=32 time=14ms TTL=57\r\nRequest timed out.\r\n" + "x" * 10**6 + "\r\n"
    (tmp_path / "ping.log").write_bytes(text.encode(encoding))
    given = testbed("link", "import", "ping.log", "--out", "t.csv", "--json")
    figures = json.loads(given.out)
    assert (figures["sent"], figures["dropped"]) == (2, 1)


def test_two_captures_with_all_options(testbed: Command, tmp_path: Path) -> None:
    frames = [
        Taken(k * MS, build.ethernet(build.ip4(build.udp(b"\x80\0" + k.to_bytes(2, "big") + b"12345678"), 17)))
        for k in range(30)
    ]
    (tmp_path / "s.pcap").write_bytes(build.pcap(frames))
    lost = {7, 14, 21}
    arrived = [Taken(frame.at_ns + 5, frame.data) for k, frame in enumerate(frames) if k not in lost]
    (tmp_path / "r.pcap").write_bytes(build.pcap(arrived))
    chosen = ("--from", "10.0.0.1", "--to", "10.0.0.2", "--from-port", 4000, "--to-port", 5000, "--protocol", "udp")
    for more in ((), ("--rtp",), ("--sequence", "2:2"), ("--match", "payload")):
        given = testbed("link", "import", "s.pcap", "--receiver", "r.pcap", "--out", "t.csv", *chosen, *more)
        assert (given.code, given.err) == (0, "")
        rows = read_rows(tmp_path / "t.csv")
        delays = {seq: None if at is None else at - sent for seq, sent, at in rows}
        assert delays == {k: None if k in lost else 5 for k in range(30)}


@pytest.mark.parametrize(
    ("arguments", "error"),
    [
        (("none.pcap",), "testbed: cannot read none.pcap: no such file or directory\n"),
        (("ping.log", "--format", "pcap"), "testbed: --format: got 'pcap'; allowed: auto, capture, ping"),
        (("ping.log", "--format", "capture"), "testbed: ping.log: got a file that begins with 36342062"),
        (("ping.log", "--protocol", "upd"), "testbed: --protocol: got 'upd'; allowed: icmp, tcp, udp; did you mean"),
        (("ping.log", "--to-port", 80), "testbed: ping.log: got a log of ping; allowed with it: --interval"),
        (("ping.log", "--interval", "20"), "testbed: --interval: got '20'; allowed: a duration with a unit"),
        (("ping.log", "--rtp", "--sequence", "0:4"), "testbed: --rtp, --sequence: got both; allowed: one of them"),
        (("ping.log", "--match", "x"), "testbed: --match: got 'x'; allowed: packet, payload"),
    ],
)
def test_wrong_input_is_one_line(testbed: Command, tmp_path: Path, arguments: tuple[str, ...], error: str) -> None:
    (tmp_path / "ping.log").write_text(PING)
    refused = testbed("link", "import", *arguments, "--out", "t.csv")
    assert (refused.code, refused.out) == (2, "")
    assert refused.err.startswith(error)
    assert refused.err.count("\n") == 1
    assert not (tmp_path / "t.csv").exists()


def test_where_nothing_can_be_written(testbed: Command, tmp_path: Path) -> None:
    (tmp_path / "ping.log").write_text(PING)
    refused = testbed("link", "import", "ping.log", "--out", "no/t.csv")
    assert (refused.code, refused.err) == (2, "testbed: cannot write no/t.csv: no such file or directory\n")


def test_presets_are_listed_and_shown(testbed: Command) -> None:
    listed = testbed("link", "presets")
    assert listed.code == 0
    for name, preset in presets().items():
        assert f"{name} " in listed.out
        shown = testbed("link", "presets", name)
        assert (shown.code, shown.err) == (0, "")
        words = " ".join(shown.out.split())
        for text in (preset.title, preset.source, preset.confirmed, *preset.caveats, *preset.assumed):
            assert " ".join(text.split()) in words
        assert ("# up" in shown.out) == (not preset.symmetric)
        assert json.loads(testbed("link", "presets", name, "--json").out) == {name: preset.model_dump()}
    assert list(json.loads(testbed("link", "presets", "--json").out)) == list(presets())
    refused = testbed("link", "presets", "airline")
    assert (refused.code, refused.out) == (2, "")
    assert refused.err.endswith("; did you mean 'airline-wifi'?\n")
