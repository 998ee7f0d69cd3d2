"""Captures into traces: the fates and delays that made them come out; what cannot be told is said in one line."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from channel.capture import build
from channel.capture.build import MS, Taken
from testbed.channel.capture.flows import Filter
from testbed.channel.capture.imported import Imported, Unwrapped
from testbed.channel.capture.numbered import RTP, Numbering
from testbed.channel.capture.read import Wish, import_trace
from testbed.errors import UsageError

START = 1_700_000_000 * 10**9
OFFSET = 3 * 10**9  # of the receiver's clock
Fate = list[int]
"""Delays of the arrivals of a packet, in ns."""


def fates(number: int, seed: int = 1) -> list[Fate]:
    """Some lost, some twice, some overtaken; the first and the last arrive once."""
    random = np.random.default_rng(seed)
    kinds = random.choice([0, 1, 2], size=number, p=[0.2, 0.7, 0.1])
    kinds[0] = kinds[-1] = 1
    return [[int(d) for d in random.integers(5 * MS, 40 * MS, size=kind)] for kind in kinds]


def sides(made: list[Fate], packet: Callable[[int], bytes]) -> tuple[list[Taken], list[Taken]]:
    """Frames of packets sent every 10 ms, at the sender and at the receiver."""
    sent = [Taken(START + k * 10 * MS, build.ethernet(packet(k))) for k in range(len(made))]
    arrived = [Taken(sent[k].at_ns + delay + OFFSET, sent[k].data) for k, delays in enumerate(made) for delay in delays]
    return sent, sorted(arrived, key=lambda taken: taken.at_ns)


def write(path: Path, frames: list[Taken]) -> Path:
    path.write_bytes(build.pcap(frames) if path.suffix == ".pcap" else build.pcapng(frames))
    return path


def check(imported: Imported, made: list[Fate], offset: int = OFFSET) -> None:
    """Every arrival and loss is there, and the rows are in the order of delivery."""
    lost = {seq for seq, _, delivered in imported.rows if delivered is None}
    assert lost == {k for k, delays in enumerate(made) if not delays}
    arrivals = sorted((seq, at - sent) for seq, sent, at in imported.rows if at is not None)
    assert arrivals == sorted((k, delay + offset) for k, delays in enumerate(made) for delay in delays)
    times = [at for _, _, at in imported.rows if at is not None]
    assert times == sorted(times)
    least = min(delay for delays in made for delay in delays) + offset
    order = [sent + least if at is None else at for _, sent, at in imported.rows]
    assert order == sorted(order)


def plain(k: int) -> bytes:
    return build.ip4(build.udp(f"message {k}".encode()), 17, number=k + 1)


def stream(k: int) -> bytes:
    return build.ip6(build.tcp(b"x" * 9, 9 * k), 6)


@pytest.mark.parametrize("packet", [plain, stream])
@pytest.mark.parametrize("suffix", ["pcap", "pcapng"])
def test_two_captures(tmp_path: Path, packet: Callable[[int], bytes], suffix: str) -> None:
    made = fates(400)
    sent, arrived = sides(made, packet)
    wish = Wish(receiver=write(tmp_path / f"r.{suffix}", arrived))
    imported = import_trace(write(tmp_path / f"s.{suffix}", sent), wish)
    check(imported, made)
    assert imported.left_out == {}
    figures = imported.figures()
    assert (figures["sent"], figures["dropped"]) == (400, sum(not delays for delays in made))
    assert figures["duplicates"] == sum(len(delays) == 2 for delays in made)
    least = min(delay for delays in made for delay in delays) + OFFSET
    assert imported.notes == [
        f"delays include the offset between the clocks of the two captures; the least is {least / MS:.3f} ms"
    ]


def test_packets_outside_the_common_time_are_left_out(tmp_path: Path) -> None:
    """The receiver's capture began late and ended early: what it did not see is not lost."""
    made = fates(100)
    sent, arrived = sides(made, plain)
    met = [k for k, delays in enumerate(made) if delays and 20 <= k < 80]
    cut = [taken for taken in arrived if any(taken.data == sent[k].data for k in met)]
    other = Taken(START, build.ethernet(build.ip4(build.udp(b"?"), 17, number=9999)))
    imported = import_trace(write(tmp_path / "s.pcap", sent), Wish(receiver=write(tmp_path / "r.pcap", [other, *cut])))
    check(imported, made[met[0] : met[-1] + 1])
    assert imported.left_out == {
        "sender: before the first or after the last packet in both": 100 - (met[-1] + 1 - met[0]),
        "receiver: not in the sender's capture": 1,
    }


def test_through_an_address_translation(tmp_path: Path) -> None:
    made = fates(50)
    sent, _ = sides(made, plain)
    _, arrived = sides(
        made, lambda k: build.ip4(build.udp(f"message {k}".encode(), 4001), 17, ends=("1.2.3.4", "5.6.7.8"))
    )
    sender, receiver = write(tmp_path / "s.pcap", sent), write(tmp_path / "r.pcap", arrived)
    with pytest.raises(UsageError, match=r"no packet that is in both; .*--match payload"):
        import_trace(sender, Wish(receiver=receiver))
    check(import_trace(sender, Wish(receiver=receiver, match=r"payload")), made)


def test_packets_that_look_the_same(tmp_path: Path) -> None:
    """They are told apart as long as all arrive."""
    sent, arrived = sides([[MS]] * 5, lambda _: build.ip4(build.udp(b"same"), 17))
    sender = write(tmp_path / "s.pcap", sent)
    check(import_trace(sender, Wish(receiver=write(tmp_path / "r.pcap", arrived))), [[MS]] * 5)
    with pytest.raises(UsageError, match=r"got 5 packets that look the same as others, some of which are missing"):
        import_trace(sender, Wish(receiver=write(tmp_path / "r.pcap", arrived[1:])))


def test_captures_that_keep_different_lengths(tmp_path: Path) -> None:
    made = fates(50)
    sent, arrived = sides(made, lambda k: build.ip4(build.udp(k.to_bytes(4, "big") + b"z" * 200), 17))
    (tmp_path / "s.pcap").write_bytes(build.pcap(sent, snap=96))
    check(import_trace(tmp_path / "s.pcap", Wish(receiver=write(tmp_path / "r.pcap", arrived))), made)


@pytest.mark.parametrize("first", [0, 65_400])
def test_numbers_of_two_captures(tmp_path: Path, first: int) -> None:
    """Two bytes, least significant first, through their end; everything else the same in each packet."""

    def numbered(k: int) -> bytes:
        return build.ip4(build.udp(b"ab" + ((first + k) % 65536).to_bytes(2, "little")), 17)

    made = fates(300)
    sent, arrived = sides(made, numbered)
    wish = Wish(receiver=write(tmp_path / "r.pcap", arrived), numbering=Numbering.parse("2:2:little"))
    check(import_trace(write(tmp_path / "s.pcap", sent), wish), made)


def test_one_capture_of_rtp(tmp_path: Path) -> None:
    def rtp(k: int) -> bytes:
        return build.ip4(build.udp(b"\x80\x60" + ((65_500 + k) % 65536).to_bytes(2, "big") + b"\0" * 8), 17)

    made = fates(300)
    _, arrived = sides(made, rtp)
    other = Taken(START, build.ethernet(build.ip4(build.udp(b"no RTP"), 17)))
    imported = import_trace(write(tmp_path / "r.pcap", [*arrived, other]), Wish(numbering=RTP))
    assert {seq for seq, _, at in imported.rows if at is None} == {k for k, delays in enumerate(made) if not delays}
    assert len(imported.rows) == sum(max(1, len(delays)) for delays in made)
    assert imported.left_out == {"without a number": 1}
    assert "one capture at the receiver tells no delays" in imported.notes[0]


@pytest.mark.parametrize("v6", [False, True])
def test_pings_of_one_capture(tmp_path: Path, v6: bool) -> None:
    made = fates(300)
    make, protocol = (build.ip6, 58) if v6 else (build.ip4, 1)
    frames = []
    for k, delays in enumerate(made):
        at, seq = START + k * 10 * MS, (65_400 + k) % 65536
        packet = make(build.echo(seq, v6=v6), protocol)
        frames.append(Taken(at, build.ethernet(packet)))
        ends = ("fd00::2", "fd00::1") if v6 else ("10.0.0.2", "10.0.0.1")
        answer = make(build.echo(seq, reply=True, v6=v6), protocol, ends=ends)
        frames += [Taken(at + delay, build.ethernet(answer)) for delay in delays]
    frames.sort(key=lambda taken: taken.at_ns)
    path = write(tmp_path / "ping.pcapng", frames)
    for wanted in (Filter(), Filter(source="fd00::1" if v6 else "10.0.0.1")):
        imported = import_trace(path, Wish(wanted=wanted))
        check(imported, made, offset=0)
        assert (imported.measures, imported.left_out) == ("round trip", {})


def test_filters_and_what_they_leave_out(tmp_path: Path) -> None:
    made = fates(60)
    sent, arrived = sides(made, plain)
    noise = [Taken(START + 1, build.ethernet(build.ip4(build.udp(b"dns", 9, 53), 17))), Taken(START, b"\0" * 60)]
    sender = write(tmp_path / "s.pcap", [*noise, *sent])
    receiver = write(tmp_path / "r.pcap", [*noise, *arrived])
    with pytest.raises(
        UsageError, match=r"s\.pcap: got 2 flows: udp 10\.0\.0\.1 port 4000 → 10\.0\.0\.2 port 5000 \(60\)"
    ):
        import_trace(sender, Wish(receiver=receiver))
    for wanted in (Filter(destination_port=5000), Filter("udp", "10.0.0.1", "10.0.0.2", 4000)):
        imported = import_trace(sender, Wish(receiver=receiver, wanted=wanted))
        check(imported, made)
        assert imported.left_out == {
            "sender: not IP": 1,
            "sender: not asked for": 1,
            "receiver: not IP": 1,
            "receiver: not asked for": 1,
        }
    with pytest.raises(UsageError, match=r"got no packet to use \(61 not asked for, 1 not IP\); allowed: one or more"):
        import_trace(sender, Wish(receiver=receiver, wanted=Filter("tcp")))


def test_what_cannot_be_told_is_a_line(tmp_path: Path) -> None:
    sent, arrived = sides(fates(30), plain)
    path, other = write(tmp_path / "s.pcap", sent), write(tmp_path / "r.pcap", arrived[:0])
    cases = [
        (Wish(), "got one capture without pings, which does not show what was lost; allowed: a second one"),
        (Wish(receiver=other), "r.pcap: got no packet to use (an empty capture); allowed: one or more"),
        (Wish(numbering=Numbering.parse("90:4")), "got no packet with a number at that place"),
        (Wish(numbering=Numbering.parse("0:8")), "in every packet; allowed: one that counts them"),
        (Wish(numbering=Numbering.parse("7:3:little")), "got sequence number"),
        (Wish(interval_ns=5), "is a capture, which has times; allowed: only with a log of ping"),
        (Wish(receiver=tmp_path / "none"), "cannot read"),
    ]
    for wish, error in cases:
        with pytest.raises(UsageError) as raised:
            import_trace(path, wish)
        assert error in str(raised.value)
        assert "\n" not in str(raised.value)


def test_sequence_numbers_go_on_where_they_wrap() -> None:
    unwrapped = Unwrapped(8, "x", jump_max=100)
    assert [unwrapped.next(n) for n in (250, 255, 3, 1, 254, 90)] == [250, 255, 259, 257, 254, 346]
    with pytest.raises(UsageError, match=r"^x: got sequence number 210 after 90; allowed: steps of 100 or less"):
        unwrapped.next(210)


@pytest.mark.parametrize("text", ["", "4", "1:0", "1:9", "a:2", "1:2:middle", "-1:2", "١:2"])
def test_no_place_of_a_number(text: str) -> None:
    with pytest.raises(UsageError, match=r"^--sequence: got .*; allowed: OFFSET:BYTES"):
        Numbering.parse(text)


def test_no_address() -> None:
    with pytest.raises(UsageError, match=r"^--to: got 'host'; allowed: an IPv4 or IPv6 address"):
        Filter(destination="host")
