"""States as bytes: what goes in comes out, bit by bit, and whatever is not so is refused in one line."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from testbed.errors import UsageError
from testbed.wire.state import pack, unpack

names = st.from_regex(r"[A-Za-z][A-Za-z0-9_.-]{0,9}", fullmatch=True)
arrays: st.SearchStrategy[Any] = st.sampled_from(["<f8", "<i8", "|u1"]).flatmap(
    lambda kind: hnp.arrays(np.dtype(kind), hnp.array_shapes(min_dims=0, max_dims=3, min_side=0, max_side=3))
)


@settings(deadline=None)
@given(st.dictionaries(names, arrays, max_size=4), st.dictionaries(names, st.integers(0, 2**63 - 1), max_size=4))
def test_what_goes_in_comes_out(given_arrays: dict[str, Any], numbers: dict[str, int]) -> None:
    found = unpack(pack(given_arrays, **numbers))
    for name, value in numbers.items():
        assert found.number(name) == value
    for name, array in found.group("").items():
        assert (array.dtype, array.shape) == (given_arrays[name].dtype, given_arrays[name].shape)
        assert array.tobytes() == given_arrays[name].tobytes()
        assert name in found
    found.end()


def test_what_is_not_finite_is_kept_and_told_to_who_reads_it_as_numbers() -> None:
    given = np.array([np.nan, -np.inf, -0.0])
    found = unpack(pack({"a": given}))
    assert found.group("a")[""].tobytes() == given.tobytes()
    with pytest.raises(UsageError, match="not finite"):
        found.array("a", np.float64, 3)


def refused(data: bytes) -> str:
    with pytest.raises(UsageError) as raised:
        unpack(data)
    assert "\n" not in str(raised.value)
    return str(raised.value)


@settings(deadline=None, max_examples=200)
@given(st.data())
def test_damage_is_seen(data: st.DataObject) -> None:
    whole = pack({"a": np.arange(5.0), "b": np.zeros(3, dtype=np.uint8)}, step=3)
    place = data.draw(st.integers(0, len(whole) - 1))
    spoilt = bytearray(whole)
    spoilt[place] ^= 1 << data.draw(st.integers(0, 7))
    refused(bytes(spoilt))
    refused(whole[:place])
    refused(whole + bytes(1 + place))
    refused(data.draw(st.binary(max_size=60)))


@pytest.mark.parametrize(
    ("given_arrays", "numbers", "expected"),
    [
        ({"a": np.zeros(2, dtype=np.float32)}, {}, "float32"),
        ({"a b": np.zeros(2)}, {}, "pattern"),
        ({}, {"step": 2**63}, "step"),
        ({}, {"step": 0.5}, "step"),
        ({f"a{i}": np.zeros(1) for i in range(257)}, {}, "256"),
    ],
)
def test_what_is_no_state_is_not_written(given_arrays: dict[str, Any], numbers: Any, expected: str) -> None:
    with pytest.raises(UsageError, match=expected) as raised:
        pack(given_arrays, **numbers)
    assert "\n" not in str(raised.value)


def test_reading_what_is_not_there_or_otherwise_is_refused() -> None:
    def fresh() -> Any:
        return unpack(pack({"a": np.zeros((2, 3))}, step=3))

    for wrong in (
        lambda s: s.array("b", np.float64, 2, 3),
        lambda s: s.array("a", np.int64, 2, 3),
        lambda s: s.array("a", np.float64, 2),
        lambda s: s.array("a", np.float64, None, 2),
        lambda s: s.number("stop"),
        lambda s: s.number("step", 2),
        lambda s: s.expect(step=4),
        lambda s: s.expect(stop=4),
        lambda s: s.end(),
        lambda s: (s.group(""), s.end()),
    ):
        with pytest.raises(UsageError):
            wrong(fresh())
    right = fresh()
    right.expect(step=3)
    assert right.array("a", np.float64, None, 3).shape == (2, 3)
    right.end()
