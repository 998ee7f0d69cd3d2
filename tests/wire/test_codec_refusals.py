"""Whatever the bytes are, ``decode`` gives a valid message or raises Rejected, with the reason."""

from __future__ import annotations

import json
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from testbed.wire.codec import MAX_HEADER, Rejected, encode
from testbed.wire.messages import Packet
from wire.samples import (
    OTHERS,
    PACKETS,
    RUN,
    SIZES,
    decoder,
    messages,
    observation,
    payload_of,
    shape_of,
    tail_of,
)

fuzz = settings(deadline=None, max_examples=150)


def reason(payload: bytes, kind: str = "observation") -> str:
    """Why a payload is refused; "accepted" if it is not."""
    try:
        header, arrays = decoder(kind).decode(payload)
    except Rejected as refusal:
        text, why = str(refusal), refusal.reason
        if not text.startswith(why) or len(text.splitlines()) != 1:
            pytest.fail(f"not one line with its reason: {text!r}")
        return why
    assert_fits(header, arrays, kind)
    return "accepted"


def assert_fits(header: Any, arrays: dict[str, Any], kind: str) -> None:
    """What every accepted message has, from the description of the types."""
    assert header.type == kind
    assert header.run == RUN
    if not isinstance(header, Packet):
        assert arrays == {}
        return
    assert 0 <= header.lane < header.lane + header.lanes <= SIZES.lanes
    assert (0 if kind == "control" else 1) <= header.step <= SIZES.steps
    assert {name for name, rule in header.ARRAYS.items() if rule.required} <= set(arrays) <= set(header.ARRAYS)
    late = arrays["late_step"].shape[1] if "late_step" in arrays else 0
    for name, array in arrays.items():
        rule = header.ARRAYS[name]
        assert array.shape == shape_of(rule, header.lanes, late=late)
        assert np.isfinite(array).all() if rule.dtype == "<f8" else np.isin(array, (0, 1)).all()
    if late:
        assert 1 <= arrays["late_step"].min() <= arrays["late_step"].max() < header.step


@fuzz
@given(st.binary(max_size=200))
def test_random_bytes_are_refused(payload: bytes) -> None:
    for kind in (*PACKETS, *OTHERS):
        assert reason(payload, kind) != "accepted"


@fuzz
@given(st.binary(max_size=120), st.integers(0, 200), st.binary(max_size=40))
def test_random_headers_are_refused(header: bytes, length: int, tail: bytes) -> None:
    assert reason(b"NCS1" + length.to_bytes(4, "little") + header + tail) != "accepted"
    assert reason(payload_of(header, tail)) != "accepted"


@pytest.mark.parametrize("kind", [*PACKETS, *OTHERS])
@settings(deadline=None, max_examples=15)
@given(data=st.data())
def test_every_truncation_and_every_extension_is_refused(kind: str, data: st.DataObject) -> None:
    payload = encode(*data.draw(messages(kind)))
    for end in range(len(payload)):
        assert reason(payload[:end], kind) != "accepted"
    assert reason(payload + b"\0", kind) == "format"
    assert reason(payload + b"\0" * 8, kind) == "format"


@pytest.mark.parametrize("kind", [*PACKETS, *OTHERS])
@settings(deadline=None, max_examples=60)
@given(data=st.data())
def test_damaged_payloads_are_refused_or_fit(kind: str, data: st.DataObject) -> None:
    damaged = bytearray(encode(*data.draw(messages(kind))))
    for _ in range(data.draw(st.integers(1, 3))):
        place = data.draw(st.integers(0, len(damaged) - 1))
        damaged[place] = data.draw(st.one_of(st.integers(0, 255), st.sampled_from(b' 0129-.e"{}[],:tn')))
    reason(bytes(damaged), kind)


@pytest.mark.parametrize("length", [MAX_HEADER + 1, 2**31, 2**32 - 1])
def test_a_huge_header_is_refused_before_it_is_read(length: int) -> None:
    assert reason(b"NCS1" + length.to_bytes(4, "little") + b" " * 100) == "format"


def test_a_header_at_the_limit_is_read() -> None:
    header, arrays = observation()
    text = json.dumps(header).encode()
    padded = text + b" " * (MAX_HEADER - len(text))
    assert reason(b"NCS1" + MAX_HEADER.to_bytes(4, "little") + padded + tail_of(arrays)) == "accepted"


@pytest.mark.parametrize(
    "text",
    [
        b"[" * 60_000,
        b'{"a":' * 10_000,
        b'{"arrays":' + b"[" * 30_000 + b"]" * 30_000 + b"}",
        b"9" * 60_000,
        b'{"seq":' + b"9" * 50_000 + b"}",
        b'{"seq":1e999}',
        b'{"run":"\\ud800"}',
        b"\xff\xfe\xfd",
        b"null",
        b"NaN",
        b"",
        b"[]",
        b'"NCS1"',
    ],
)
def test_json_that_no_header_is_made_of_is_refused(text: bytes) -> None:
    assert reason(payload_of(text)) == "schema"


def changed(tail: bytes | None = None, **changes: Any) -> bytes:
    header, arrays = observation(**changes)
    return payload_of({k: v for k, v in header.items() if v is not ...}, tail_of(arrays) if tail is None else tail)


def test_the_sample_is_accepted() -> None:
    assert reason(changed()) == "accepted"
    assert reason(changed(b"", arrays=[])) == "accepted"
    assert reason(changed(b"", arrays=...)) == "accepted"


@pytest.mark.parametrize("key", ["v", "type", "run", "source", "seq", "step", "lane", "lanes"])
@pytest.mark.parametrize("value", [..., None, True, "", "1", -1, 1.5, 2**63, [], {}, "Ünicode\n"])
def test_fields_that_lack_or_are_of_a_wrong_kind(key: str, value: Any) -> None:
    assert reason(changed(**{key: value})) == "schema"


@pytest.mark.parametrize(
    ("expected", "changes"),
    [
        ("schema", {"v": 2}),
        ("schema", {"type": "control"}),
        ("schema", {"lanes": 0}),
        ("schema", {"extra": 1}),
        ("schema", {"source": "Plant"}),
        ("schema", {"run": RUN.upper()}),
        ("run", {"run": "another0run0"}),
        ("range", {"step": 0}),
        ("range", {"step": 51}),
        ("range", {"step": 2**63 - 1}),
        ("range", {"lane": 3}),
        ("range", {"lane": 6}),
        ("range", {"lane": 2**63 - 1}),
        ("range", {"lanes": 5}),
        ("range", {"lanes": 2**31}),
        ("shape", {"lanes": 3}),
        ("shape", {"arrays": [["y", "<f8", [4]], ["mask", "|u1", [4]]]}),
        ("shape", {"arrays": [["y", "<f8", [4, 2]], ["mask", "|u1", [4]]]}),
        ("shape", {"arrays": [["y", "<f8", [1, 4]], ["mask", "|u1", [4]]]}),
        ("shape", {"arrays": [["y", "<f8", [2**62, 4]], ["mask", "|u1", [4]]]}),
        ("shape", {"arrays": [["y", "<f8", []], ["mask", "|u1", [4]]]}),
        ("shape", {"arrays": [["y", "|u1", [4, 1]], ["mask", "|u1", [4]]]}),
        ("shape", {"arrays": [["y", "<f8", [4, 1]], ["mask", "<f8", [4]]]}),
        ("schema", {"arrays": [["y", "<f4", [4, 1]], ["mask", "|u1", [4]]]}),
        ("schema", {"arrays": [["y", "<f8", [-4, 1]], ["mask", "|u1", [4]]]}),
        ("schema", {"arrays": [["y", "<f8"], ["mask", "|u1", [4]]]}),
        ("schema", {"arrays": [["y", "<f8", [4, 1], 0], ["mask", "|u1", [4]]]}),
        ("schema", {"arrays": "y"}),
        ("arrays", {"arrays": [["y", "<f8", [4, 1]], ["y", "<f8", [4, 1]]]}),
        ("arrays", {"arrays": [["z", "<f8", [4, 1]], ["mask", "|u1", [4]]]}),
        ("format", {"arrays": [["y", "<f8", [4, 1]]]}),
        ("format", {"arrays": []}),
    ],
)
def test_headers_that_do_not_fit_the_run(expected: str, changes: dict[str, Any]) -> None:
    assert reason(changed(**changes)) == expected


@pytest.mark.parametrize("wrong", [np.nan, np.inf, -np.inf])
@pytest.mark.parametrize("place", range(4))
def test_values_that_are_not_finite_are_refused(wrong: float, place: int) -> None:
    header, arrays = observation()
    arrays["y"][place] = wrong
    assert reason(payload_of(header, tail_of(arrays))) == "finite"


@pytest.mark.filterwarnings("error")
def test_large_values_are_accepted_without_a_warning() -> None:
    header, arrays = observation()
    arrays["y"][:] = 1.7e308
    assert reason(payload_of(header, tail_of(arrays))) == "accepted"
    arrays["y"][3] = np.inf
    assert reason(payload_of(header, tail_of(arrays))) == "finite"


@pytest.mark.parametrize("wrong", [2, 3, 128, 255])
@pytest.mark.parametrize("place", range(4))
def test_masks_other_than_0_and_1_are_refused(wrong: int, place: int) -> None:
    header, arrays = observation()
    arrays["mask"][place] = wrong
    assert reason(payload_of(header, tail_of(arrays))) == "mask"


def test_required_arrays_must_be_there() -> None:
    header, _ = observation(type="estimate", arrays=[["x_hat", "<f8", [4, 2]]])
    assert reason(payload_of(header, np.zeros((4, 2)).tobytes()), "estimate") == "arrays"
    assert reason(payload_of({**header, "arrays": []}), "estimate") == "arrays"


def test_a_mask_cannot_say_that_what_is_not_there_arrived() -> None:
    header, _ = observation(arrays=[["mask", "|u1", [4]]])
    assert reason(payload_of(header, bytes(8))) == "accepted"
    assert reason(payload_of(header, bytes([0, 0, 1, 0, 0, 0, 0, 0]))) == "arrays"


def test_a_control_packet_is_of_a_step_before_the_last() -> None:
    header, _ = observation(type="control", source="controller", arrays=[])
    assert [reason(payload_of({**header, "step": k}), "control") for k in (0, 49)] == ["accepted"] * 2
    assert [reason(payload_of({**header, "step": k}), "control") for k in (50, 51)] == ["range"] * 2


def test_a_header_that_is_not_padded_is_refused() -> None:
    header, arrays = observation()
    text = json.dumps(header).encode()
    text += b" " * (-len(text) % 8 + 4)
    assert reason(b"NCS1" + len(text).to_bytes(4, "little") + text + tail_of(arrays)) == "format"


LATE: dict[str, Any] = {
    "mask": np.array([1, 0, 1, 1], dtype=np.uint8),
    "y": np.arange(4.0).reshape(4, 1),
    "late_y": np.ones((4, 2, 1)),
    "late_mask": np.ones((4, 2), dtype=np.uint8),
    "late_step": np.tile([3.0, 5.0], (4, 1)),
}


@pytest.mark.parametrize(
    ("changes", "reason"),
    [
        ({}, None),
        ({"late_step": np.tile([3.0, 7.0], (4, 1))}, "range"),
        ({"late_step": np.tile([0.0, 5.0], (4, 1))}, "range"),
        ({"late_step": np.tile([5.0, 3.0], (4, 1))}, "range"),
        ({"late_step": np.tile([3.0, 3.0], (4, 1))}, "range"),
        ({"late_step": np.tile([3.0, 4.5], (4, 1))}, "range"),
        ({"late_step": np.array([[3.0, 5.0]] * 3 + [[3.0, 6.0]])}, "range"),
        ({"late_mask": np.ones((4, 3), dtype=np.uint8)}, "shape"),
        ({"late_mask": np.full((4, 2), 2, dtype=np.uint8)}, "mask"),
        ({"late_y": None}, "arrays"),
        ({"late_step": None}, "arrays"),
        (
            {"late_y": np.ones((4, 0, 1)), "late_mask": np.ones((4, 0), np.uint8), "late_step": np.ones((4, 0))},
            "arrays",
        ),
    ],
)
def test_late_ones_are_of_earlier_steps_and_whole(changes: dict[str, Any], reason: str | None) -> None:
    arrays = {name: array for name, array in {**LATE, **changes}.items() if array is not None}
    header, _ = observation(
        step=7, arrays=[[n, "<f8" if a.dtype == float else "|u1", a.shape] for n, a in arrays.items()]
    )
    payload = payload_of(header, tail_of(arrays))
    reader = decoder("observation")
    for _ in range(2):  # the second time the header is known
        if reason is None:
            assert reader.decode(payload)[1].keys() == arrays.keys()
        else:
            with pytest.raises(Rejected) as refusal:
                reader.decode(payload)
            assert refusal.value.reason == reason
