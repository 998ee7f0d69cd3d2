"""The codec: what is written reads back, as views, and follows the description of the format."""

from __future__ import annotations

import json

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from testbed.wire.codec import MAGIC, Decoder, PacketEncoder, Sizes, all_finite, encode
from testbed.wire.messages import MESSAGES, Control, Observation, Packet
from wire.samples import OTHERS, PACKETS, RUN, decoder, header_of, messages, names, packets, payload_of, tail_of

check = settings(deadline=None, max_examples=40)


@pytest.mark.parametrize("kind", [*PACKETS, *OTHERS])
@check
@given(data=st.data())
def test_what_is_encoded_decodes_to_the_same(kind: str, data: st.DataObject) -> None:
    message, arrays = data.draw(messages(kind))
    header, read = decoder(kind).decode(encode(message, arrays))
    assert header == message
    assert list(read) == list(arrays)
    for name, array in arrays.items():
        assert read[name].dtype == array.dtype
        assert read[name].shape == array.shape
        assert read[name].tobytes() == array.tobytes()


@pytest.mark.parametrize("kind", PACKETS)
@check
@given(data=st.data())
def test_bytes_are_those_of_the_description(kind: str, data: st.DataObject) -> None:
    packet, arrays = data.draw(packets(kind))
    payload = encode(packet, arrays)
    length = int.from_bytes(payload[4:8], "little")
    assert payload[:4] == MAGIC == b"NCS1"
    assert length % 8 == 0
    assert json.loads(payload[8 : 8 + length]) == json.loads(packet.model_dump_json())
    assert payload[8 + length :] == tail_of(arrays)


@pytest.mark.parametrize("kind", PACKETS)
@check
@given(data=st.data())
def test_a_payload_put_together_by_hand_is_read(kind: str, data: st.DataObject) -> None:
    packet, arrays = data.draw(packets(kind))
    by_hand = payload_of(json.dumps(packet.model_dump(mode="json"), indent=1).encode(), tail_of(arrays))
    header, read = decoder(kind).decode(by_hand)
    assert header == packet
    assert {name: array.tolist() for name, array in read.items()} == {n: a.tolist() for n, a in arrays.items()}


@pytest.mark.parametrize("kind", PACKETS)
@check
@given(data=st.data())
def test_the_packet_encoder_writes_what_encode_writes(kind: str, data: st.DataObject) -> None:
    packet, arrays = data.draw(packets(kind))
    model = MESSAGES[kind]
    assert issubclass(model, Packet)
    encoder = PacketEncoder(model, packet.run, packet.source)
    for _ in range(2):  # the second time the list of arrays is remembered
        fast = encoder.encode(packet.seq, packet.step, packet.lane, packet.lanes, arrays)
        slow = encode(packet, arrays)
        assert header_of(fast) == header_of(slow)
        assert fast[8 + int.from_bytes(fast[4:8], "little") :] == slow[8 + int.from_bytes(slow[4:8], "little") :]
        assert decoder(kind).decode(fast)[0] == packet


@check
@given(source=names, other=names)
def test_packet_encoders_do_not_mix_their_shapes(source: str, other: str) -> None:
    first, second = PacketEncoder(Observation, RUN, source), PacketEncoder(Observation, RUN, other)
    for encoder, name in ((first, source), (second, other), (first, source)):
        for lanes in (1, 3, 1):
            payload = encoder.encode(0, 1, 0, lanes, {"y": np.zeros((lanes, 1))})
            header, arrays = decoder("observation").decode(payload)
            assert (header.source, arrays["y"].shape) == (name, (lanes, 1))


@pytest.mark.parametrize("kind", PACKETS)
@check
@given(data=st.data())
def test_arrays_are_aligned_read_only_views(kind: str, data: st.DataObject) -> None:
    packet, arrays = data.draw(packets(kind))
    payload = encode(packet, arrays)
    buffer = np.frombuffer(payload, np.uint8)
    for array in decoder(kind).decode(payload)[1].values():
        assert np.shares_memory(array, buffer)
        assert array.flags.aligned
        assert array.flags.c_contiguous
        assert not array.flags.writeable
        assert (array.__array_interface__["data"][0] - buffer.__array_interface__["data"][0]) % 8 == 0


@pytest.mark.parametrize(
    "layout",
    [
        lambda a: np.asfortranarray(a),
        lambda a: np.ascontiguousarray(a[::-1])[::-1],
        lambda a: np.repeat(a, 2, axis=1)[:, ::2],
        lambda a: np.broadcast_to(a[:1], a.shape),
    ],
)
def test_any_memory_layout_is_written_in_order(layout: object) -> None:
    u = layout(np.arange(12.0).reshape(4, 3))  # type: ignore[operator]
    payload = PacketEncoder(Control, RUN, "controller").encode(0, 0, 0, 4, {"u": u})
    np.testing.assert_array_equal(decoder("control").decode(payload)[1]["u"], u)


def test_a_system_without_input_has_empty_control_packets() -> None:
    sizes = Sizes(n=2, p=1, q=0, lanes=3, steps=5)
    payload = PacketEncoder(Control, RUN, "controller").encode(0, 0, 0, 3, {"u": np.zeros((3, 0))})
    _, arrays = Decoder(Control, RUN, sizes).decode(payload)
    assert arrays["u"].shape == (3, 0)


@pytest.mark.parametrize("wrong", [np.float32, np.int64, np.bool_, ">f8", np.complex128, object])
def test_other_element_types_cannot_be_sent(wrong: object) -> None:
    with pytest.raises(TypeError):
        PacketEncoder(Observation, RUN, "plant").encode(0, 1, 0, 1, {"y": np.zeros((1, 1), dtype=wrong)})  # type: ignore[call-overload]


numbers = st.one_of(
    st.floats(),
    st.sampled_from([np.inf, -np.inf, np.nan, 1e308, -1e308, 1e200, 5e-324, 0.0, -0.0]),
)


@settings(deadline=None, max_examples=400)
@given(hnp.arrays(np.float64, st.integers(0, 40), elements=numbers))
def test_all_finite_is_what_it_says(x: np.ndarray) -> None:
    with np.errstate(all="raise"):
        assert all_finite(x) == bool(np.isfinite(x).all())


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("size", [0, 1, 2, 3, 7, 8, 64, 1001])
@pytest.mark.parametrize("wrong", [np.inf, -np.inf, np.nan])
def test_all_finite_looks_everywhere(size: int, wrong: float) -> None:
    for fill in (0.0, 1.0, 1e300, -1e300):
        assert all_finite(np.full(size, fill))
        for place in range(size):
            x = np.full(size, fill)
            x[place] = wrong
            assert not all_finite(x)
            if size > 100:
                break
