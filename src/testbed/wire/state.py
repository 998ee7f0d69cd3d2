"""The state of a block of lanes of a service as bytes: named arrays and a few integers.

Bytes: ``NCST`` and what ``testbed.numerics.packed`` says. Numbers that are not
finite are kept, bit by bit; who reads them with ``Unpacked.array`` is told.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated, Any

from numpy.typing import NDArray
from pydantic import Field

from testbed.errors import UsageError
from testbed.numerics.packed import Header, Layout, Name, Named

MAX_BYTES = 1 << 29
LARGEST = 2**63 - 1

_Numbers = dict[Name, Annotated[int, Field(ge=-(2**63), le=LARGEST)]]


class _Header(Header):
    numbers: Annotated[_Numbers, Field(max_length=256)]


_LAYOUT = Layout(b"NCST", "state", _Header, MAX_BYTES)


class Unpacked(Named):
    """The arrays and numbers of a state. Raises UsageError for those that are not as they are asked for."""

    def __init__(self, arrays: Mapping[str, NDArray[Any]], numbers: Mapping[str, int]) -> None:
        super().__init__(arrays)
        self._numbers = dict(numbers)

    def number(self, name: str, largest: int = LARGEST) -> int:
        """0 … largest."""
        value = self._numbers.pop(name, None)
        if value is None or not 0 <= value <= largest:
            raise UsageError(f"state: {name!r} is {'missing' if value is None else value}; allowed: 0 … {largest}")
        return value

    def expect(self, **numbers: int) -> None:
        """These numbers, and no others."""
        for name, expected in numbers.items():
            value = self._numbers.pop(name, None)
            if value != expected:
                raise UsageError(f"state: {name} is {'missing' if value is None else value}; expected {expected}")

    def end(self) -> None:
        super().end()
        for name in self._numbers:
            raise UsageError(f"state: unknown {name!r}")


def pack(arrays: Mapping[str, NDArray[Any]], **numbers: int) -> bytes:
    """Raises UsageError for an array that is not float64, int64 or uint8, for a wrong name, or for too many bytes."""
    return _LAYOUT.write({"numbers": numbers}, arrays)


def unpack(data: bytes) -> Unpacked:
    """Raises UsageError for what ``pack`` does not write."""
    header, arrays = _LAYOUT.read(data)
    return Unpacked(arrays, header.numbers)
