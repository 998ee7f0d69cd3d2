"""Durations: their units, their bounds, their shortest text."""

import pytest
from hypothesis import given
from hypothesis import strategies as st
from pydantic_core import PydanticCustomError

from testbed.scenario import format_duration, parse_duration


@pytest.mark.parametrize(
    ("text", "ns"),
    [
        ("1 ns", 1),
        ("250 us", 250_000),
        ("10 ms", 10_000_000),
        ("1 s", 1_000_000_000),
        ("5 min", 300_000_000_000),
        ("2.5us", 2_500),
        ("0.000000001 s", 1),
        (" 1.50  ms ", 1_500_000),
        ("9223372036854775807 ns", 2**63 - 1),
    ],
)
def test_units(text: str, ns: int) -> None:
    assert parse_duration(text) == ns


@pytest.mark.parametrize(
    "value",
    ["", "10", "ms", "10 h", "10 sec", "-1 s", "1e3 ms", "1,5 s", "nan s", "1 s 2 ms", "١ s", 10, 1.5, True, None, []],
)
def test_no_duration(value: object) -> None:
    with pytest.raises(PydanticCustomError, match=r"allowed: a duration with a unit \(ns, us, ms, s, min\)"):
        parse_duration(value)


@pytest.mark.parametrize(
    "value", ["0 s", "0.1 ns", "1.0000000001 s", "9223372036854775808 ns", "9999999999999999999 min"]
)
def test_no_whole_number_of_nanoseconds(value: str) -> None:
    with pytest.raises(PydanticCustomError, match="whole number of nanoseconds"):
        parse_duration(value)


@given(st.integers(1, 2**63 - 1))
def test_text_is_exact(ns: int) -> None:
    assert parse_duration(format_duration(ns)) == ns


@pytest.mark.parametrize(
    ("ns", "text"), [(1, "1 ns"), (1_500_000, "1500 us"), (60_000_000_000, "1 min"), (1_000, "1 us")]
)
def test_text_is_in_the_largest_unit(ns: int, text: str) -> None:
    assert format_duration(ns) == text
