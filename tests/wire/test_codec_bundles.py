"""Bundles are read at once where their messages are alike: what is said of each must be what is said of it alone."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from testbed.wire.bundle import bundle
from testbed.wire.codec import Decoder, PacketEncoder, Rejected
from testbed.wire.messages import MESSAGES, Packet
from wire.samples import PACKETS, RUN, Arrays, decoder, packets


def said(outcome: Any) -> Any:
    """All that a decoder says of a message."""
    if isinstance(outcome, Rejected):
        return outcome.reason
    header, arrays = outcome
    copies = {name: (array.dtype.str, array.shape, array.tobytes()) for name, array in arrays.items()}
    return type(header), header.model_dump(), header.model_fields_set, copies


def alone(made: Decoder[Any], message: bytes) -> Any:
    try:
        return said(made.decode(message))
    except Rejected as refusal:
        return refusal.reason


@st.composite
def series(draw: st.DrawFn, kind: str) -> list[bytes]:
    """Messages of one sender, each with its own numbers and values; some of them damaged."""
    packet, arrays = draw(packets(kind))
    encoder = PacketEncoder(type(packet), packet.run, packet.source)
    messages = []
    for i in range(draw(st.integers(1, 6))):
        values: Arrays = {
            name: np.roll(a, i, axis=0) if a.dtype == np.float64 and a.size else a for name, a in arrays.items()
        }
        step = draw(st.sampled_from([packet.step, packet.step + i, 0, 10**13]))
        message = bytearray(encoder.encode(packet.seq % 10**9 + i, step, packet.lane, packet.lanes, values))
        if draw(st.integers(0, 3)) == 0:
            place = draw(st.integers(0, len(message) - 1))
            message[place] = draw(st.sampled_from([0, 1, 2, 0x7F, 0xF0, 0xFF, *b'09a":,}{[ ']))
        if draw(st.integers(0, 7)) == 0:
            message += b"\0" * 8
        messages.append(bytes(message))
    return messages


@pytest.mark.parametrize("kind", PACKETS)
@settings(deadline=None, max_examples=80)
@given(data=st.data())
def test_a_bundle_is_read_as_its_messages_are(kind: str, data: st.DataObject) -> None:
    messages = data.draw(series(kind))
    read = list(decoder(kind).read(bundle(messages)))
    assert [message for message, _ in read] == messages
    assert [said(outcome) for _, outcome in read] == [alone(decoder(kind), message) for message in messages]


@pytest.mark.parametrize(
    ("name", "wrong"), [("y", np.nan), ("y", np.inf), ("mask", 2), ("step", 0), ("step", 51), ("step", 10**13)]
)
def test_one_wrong_message_does_not_spoil_the_others(name: str, wrong: float) -> None:
    encoder = PacketEncoder(MESSAGES["observation"], RUN, "link.observation")  # type: ignore[arg-type]
    messages = []
    for i in range(5):
        arrays: dict[str, Any] = {"y": np.full((3, 1), 0.5 + i), "mask": np.ones(3, dtype=np.uint8)}
        if i == 3 and name in arrays:
            arrays[name].flat[1] = wrong
        messages.append(encoder.encode(i, int(wrong) if i == 3 and name == "step" else i + 1, 0, 3, arrays))
    outcomes = [outcome for _, outcome in decoder("observation").read(bundle(messages))]
    assert isinstance(outcomes.pop(3), Rejected)
    taken = [outcome for outcome in outcomes if not isinstance(outcome, Rejected)]
    assert [header.seq for header, _ in taken] == [0, 1, 2, 4]
    assert [arrays["y"][2, 0] for _, arrays in taken] == [0.5, 1.5, 2.5, 4.5]


def test_what_a_bundle_holds_is_read_only_and_aligned() -> None:
    encoder = PacketEncoder(MESSAGES["estimate"], RUN, "estimator.aoe")  # type: ignore[arg-type]
    arrays = {"x_hat": np.arange(6.0).reshape(3, 2), "P": np.arange(12.0).reshape(3, 2, 2)}
    payload = bundle([encoder.encode(i, i + 1, 0, 3, arrays) for i in range(4)])
    for _, outcome in decoder("estimate").read(payload):
        assert not isinstance(outcome, Rejected)
        header, read = outcome
        assert isinstance(header, Packet)
        for name, array in read.items():
            np.testing.assert_array_equal(array, arrays[name])
            assert array.flags.aligned
            assert array.flags.c_contiguous
            assert not array.flags.writeable


def test_numbers_of_any_length_are_written_and_read() -> None:
    encoder = PacketEncoder(MESSAGES["observation"], RUN, "plant")  # type: ignore[arg-type]
    made = decoder("observation")
    for seq in (0, 9, 10**11, 10**12 - 1, 10**12, 10**17, 2**63 - 1, 3):
        message = encoder.encode(seq, 7, 0, 1, {"y": np.zeros((1, 1))})
        assert made.decode(message)[0].seq == seq
        assert len(message) % 8 == 0
