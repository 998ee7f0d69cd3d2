"""A decoder remembers the headers it has found valid: what it says of a payload must not depend on what came before."""

from __future__ import annotations

import re
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from testbed.wire.codec import Decoder, PacketEncoder, Rejected, encode
from testbed.wire.messages import MESSAGES, Packet
from wire.samples import PACKETS, RUN, Arrays, decoder, observation, packets, payload_of, tail_of

numbers = st.one_of(
    st.integers(-1, 60).map(str),
    st.sampled_from(["00", "01", "007", "1.0", "1e1", "-0", "+1", " 1", '"1"', "true", "null", "0x1", "٣"]),
    st.sampled_from([str(2**63 - 1), str(2**63), "9" * 18, "9" * 19, "1" + "0" * 30]),
)


def verdict(made: Decoder[Any], payload: bytes) -> Any:
    """All that a decoder says of a payload."""
    try:
        header, arrays = made.decode(payload)
    except Rejected as refusal:
        return refusal.reason
    copies = {name: (array.dtype.str, array.shape, array.tobytes()) for name, array in arrays.items()}
    return type(header), header.model_dump(), header.model_fields_set, copies


def fast(packet: Packet, arrays: Arrays, **changes: int) -> bytes:
    """The payload as PacketEncoder writes it."""
    own = {"seq": packet.seq, "step": packet.step, "lane": packet.lane, **changes}
    encoder = PacketEncoder(type(packet), packet.run, packet.source)
    return encoder.encode(own["seq"], own["step"], own["lane"], packet.lanes, arrays)


def edited(payload: bytes, pattern: bytes, replacement: bytes) -> bytes:
    """The payload with a part of the text of its header replaced."""
    end = 8 + int.from_bytes(payload[4:8], "little")
    text = payload[8:end].rstrip(b" ")
    return payload_of(re.sub(pattern, lambda _: replacement, text, count=1), payload[end:])


@st.composite
def variants(draw: st.DrawFn, packet: Packet, arrays: Arrays) -> bytes:
    """A payload like one that was accepted, or not quite."""
    payload = fast(packet, arrays)
    what = draw(st.sampled_from(["numbers", "text", "twice", "values", "bytes", "spaces", "slow", "short"]))
    if what == "numbers":
        changes = {key: draw(st.integers(0, 60)) for key in draw(st.sets(st.sampled_from(["seq", "step", "lane"])))}
        return fast(packet, arrays, **changes)
    if what == "text":
        key = draw(st.sampled_from(["seq", "step", "lane", "lanes", "v"])).encode()
        return edited(payload, b'"' + key + b'":[0-9]+', b'"' + key + b'":' + draw(numbers).encode())
    if what == "twice":
        key = draw(st.sampled_from(["seq", "step", "lane", "lanes", "v", "run", "source", "extra", "arrays"]))
        value = draw(st.sampled_from(["1", "2", "99", '"somebody"', '"another0run0"', "[]"]))
        again = f'"{key}":{value}'.encode()
        return (
            edited(payload, rb"\}$", b"," + again + b"}")
            if draw(st.booleans())
            else edited(payload, rb"^\{", b"{" + again + b",")
        )
    if what == "spaces":
        place = draw(st.sampled_from([rb",", rb":", rb"\{", rb"\]"]))
        return edited(payload, place, draw(st.sampled_from([b" ", b"\n", b"\t"])) + place.strip(b"\\"))
    if what == "slow":
        return encode(packet, arrays)
    if what == "short":
        return payload[: draw(st.integers(0, len(payload)))] + draw(st.binary(max_size=9))
    damaged = bytearray(payload)
    end = 8 + int.from_bytes(payload[4:8], "little")
    place = draw(
        st.integers(end, len(payload) - 1)
        if what == "values" and end < len(payload)
        else st.integers(0, len(payload) - 1)
    )
    damaged[place] = draw(st.sampled_from([0, 1, 2, 0x7F, 0xF0, 0xFF, *b'09a":,}{[ ']))
    return bytes(damaged)


@pytest.mark.parametrize("kind", PACKETS)
@settings(deadline=None, max_examples=60)
@given(data=st.data())
def test_what_came_before_does_not_matter(kind: str, data: st.DataObject) -> None:
    remembering = decoder(kind)
    for packet, arrays in data.draw(st.lists(packets(kind), min_size=1, max_size=2)):
        assert verdict(remembering, fast(packet, arrays)) == verdict(decoder(kind), fast(packet, arrays))
        for _ in range(6):
            payload = data.draw(variants(packet, arrays))
            assert verdict(remembering, payload) == verdict(decoder(kind), payload)


@pytest.mark.parametrize("seen", [1, 100])
def test_known_headers_are_checked_as_new_ones(seen: int) -> None:
    """Step and lane out of range, values, masks and lengths, behind a header that was accepted before."""
    made = decoder("observation")
    header, arrays = observation(lanes=2, arrays=[["y", "<f8", [2, 1]], ["mask", "|u1", [2]]])
    arrays = {"y": arrays["y"][:2], "mask": arrays["mask"][:2]}
    packet = MESSAGES["observation"].model_validate({**header, "arrays": (("y", "<f8", (2, 1)), ("mask", "|u1", (2,)))})
    assert isinstance(packet, Packet)
    for seq in range(seen):
        assert made.decode(fast(packet, arrays, seq=seq))[0].seq == seq
    reasons = {
        "range": [fast(packet, arrays, step=0), fast(packet, arrays, step=51), fast(packet, arrays, lane=5)],
        "format": [fast(packet, arrays) + b"\0" * 8, fast(packet, arrays)[:-8]],
        "finite": [
            fast(packet, {**arrays, "y": np.array([[np.nan], [0.0]])}),
            fast(packet, {**arrays, "y": np.array([[np.inf], [-np.inf]])}),
        ],
        "mask": [fast(packet, {**arrays, "mask": np.array([1, 2], dtype=np.uint8)})],
    }
    for reason, payloads in reasons.items():
        for payload in payloads:
            assert verdict(made, payload) == reason
    taken, read = made.decode(fast(packet, arrays, seq=10**9, step=50, lane=4))
    assert (taken.seq, taken.step, taken.lane, taken.lanes, taken.source) == (10**9, 50, 4, 2, "link.observation")
    np.testing.assert_array_equal(read["y"], arrays["y"])


@pytest.mark.parametrize("again", [b'"seq":5', b'"step":7', b'"lane":0', b'"lanes":4', b'"arrays":[]'])
def test_a_key_that_is_there_twice_counts_as_it_does_in_a_new_header(again: bytes) -> None:
    remembering = decoder("observation")
    packet, arrays = decoder("observation").decode(payload_of(observation()[0], tail_of(observation()[1])))
    assert isinstance(packet, Packet)
    for seq in (1, 2, 3):
        for pattern, replacement in ((rb"\}$", b"," + again + b"}"), (rb"^\{", b"{" + again + b",")):
            payload = edited(fast(packet, arrays, seq=seq), pattern, replacement)
            assert verdict(remembering, payload) == verdict(decoder("observation"), payload)


def test_headers_of_many_senders_do_not_fill_the_memory() -> None:
    made = decoder("observation")
    for i in range(1000):
        payload = PacketEncoder(MESSAGES["observation"], RUN, f"s{i}").encode(0, 1, 0, 1, {"y": np.zeros((1, 1))})  # type: ignore[arg-type]
        assert made.decode(payload)[0].source == f"s{i}"
    held = [value for value in vars(made).values() if isinstance(value, dict)]
    assert all(len(value) <= 200 for value in held)


def test_large_values_behind_a_known_header() -> None:
    made = decoder("observation")
    header, arrays = observation()
    for fill in (1.0, 1.7e308, -1.7e308):
        arrays["y"][:] = fill
        assert verdict(made, payload_of(header, tail_of(arrays))) != "finite"
