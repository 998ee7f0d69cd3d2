"""Bundles: what goes in comes out in order, and what is not a whole bundle is left for the codec to refuse."""

from __future__ import annotations

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from testbed.wire.bundle import bundle, unbundle
from testbed.wire.codec import Rejected
from wire.samples import decoder

check = settings(deadline=None, max_examples=150)
messages = st.lists(
    st.one_of(st.just(b""), st.binary(max_size=40), st.builds(lambda b: b"NCS1" + b, st.binary())), min_size=1
)


@check
@given(messages)
def test_messages_come_out_as_they_went_in(sent: list[bytes]) -> None:
    assert unbundle(bundle(sent)) == sent


@check
@given(st.lists(st.binary(max_size=20), min_size=2, max_size=5))
def test_bytes_are_those_of_the_description(sent: list[bytes]) -> None:
    expected = b"NCSB" + len(sent).to_bytes(4, "little")
    for message in sent:
        expected += len(message).to_bytes(8, "little") + message
    assert bundle(sent) == expected


@check
@given(st.lists(st.binary(max_size=20), min_size=2, max_size=5), st.data())
def test_what_is_not_whole_comes_back_as_it_is(sent: list[bytes], data: st.DataObject) -> None:
    whole = bundle(sent)
    cut = whole[: data.draw(st.integers(0, len(whole) - 1))]
    assert unbundle(cut) == [cut]
    longer = whole + data.draw(st.binary(min_size=1, max_size=9))
    assert unbundle(longer) == [longer]


@check
@given(st.one_of(st.binary(max_size=60), st.builds(lambda b: b"NCSB" + b, st.binary(max_size=60))))
def test_whatever_comes_at_least_one_message_comes_out_and_none_is_accepted(payload: bytes) -> None:
    out = unbundle(payload)
    assert out
    for message in out:
        with pytest.raises(Rejected):
            decoder("observation").decode(message)


@pytest.mark.parametrize("payload", [b"NCSB", b"NCSB\0\0\0\0", b"NCSB\xff\xff\xff\xff", b"NCSB\1\0\0\0" + b"\xff" * 8])
def test_bundles_of_nothing_are_refused_like_any_other_rubbish(payload: bytes) -> None:
    assert unbundle(payload) == [payload]


def test_a_bundle_in_a_bundle_is_not_opened() -> None:
    inner = bundle([b"a", b"b"])
    assert unbundle(bundle([inner, b"c"])) == [inner, b"c"]
