"""Named arrays as bytes, and back.

Bytes: four bytes that say what it is, uint32 header length, JSON header, the arrays it lists one after the other
(little-endian, C order), and the BLAKE2b digest (16 bytes) of all that. Numbers come back bit by bit, NaN and inf too.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from hashlib import blake2b
from typing import Annotated, Any, Final, Generic, Literal, TypeVar

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field, ValidationError

from testbed.errors import UsageError, did_you_mean

MAX_HEADER = 1 << 16
FORMAT: Final = 1
DIGEST = 16
_CODES: dict[str, np.dtype[Any]] = {"<f8": np.dtype("<f8"), "<i8": np.dtype("<i8"), "|u1": np.dtype("u1")}

Name = Annotated[str, Field(pattern=r"^[A-Za-z][A-Za-z0-9_.-]{0,63}$")]
_Shape = Annotated[tuple[Annotated[int, Field(ge=0, le=2**31)], ...], Field(max_length=8)]
_Entry = tuple[Name, Literal["<f8", "<i8", "|u1"], _Shape]


class Header(BaseModel):
    """What every header has; a kind of bytes adds its own fields."""

    model_config = ConfigDict(frozen=True, extra="forbid", strict=True)

    v: Literal[1] = FORMAT
    arrays: Annotated[tuple[_Entry, ...], Field(max_length=256)]


H = TypeVar("H", bound=Header)


class Layout(Generic[H]):
    """One kind of bytes. magic: its first four; what: its name in errors; largest: bytes but for the digest."""

    def __init__(self, magic: bytes, what: str, header: type[H], largest: int) -> None:
        self._magic, self._what, self._header, self._largest = magic, what, header, largest

    def write(self, fields: Mapping[str, Any], arrays: Mapping[str, NDArray[Any]]) -> bytes:
        """Raises UsageError for a type that has no code, for a header that is none, or for too many bytes."""
        size = sum(array.nbytes for array in arrays.values())
        if size > self._largest - MAX_HEADER:
            raise self._error(f" of {size} bytes; allowed: {self._largest - MAX_HEADER}")
        entries, content = [], []
        for name, array in arrays.items():
            code = next((code for code, dtype in _CODES.items() if array.dtype == dtype), None)
            if code is None:
                raise self._error(f": {name!r} is {array.dtype}; allowed: float64, int64, uint8")
            entries.append((name, code, array.shape))
            content.append(np.ascontiguousarray(array, dtype=_CODES[code]).tobytes())
        try:
            header = self._header.model_validate({"v": FORMAT, **fields, "arrays": tuple(entries)})
        except ValidationError as error:
            raise self._error(f": {_first(error)}") from None
        text = header.model_dump_json().encode()
        if len(text) > MAX_HEADER:
            raise self._error(f": header of {len(text)} bytes; allowed: {MAX_HEADER}")
        body = b"".join([self._magic, len(text).to_bytes(4, "little"), text, *content])
        return body + _digest(body)

    def read(self, data: bytes) -> tuple[H, dict[str, NDArray[Any]]]:
        """The header, and the arrays as views of ``data``. Raises UsageError for what ``write`` does not write."""
        if not 8 + DIGEST <= len(data) <= self._largest + DIGEST:
            raise self._error(f" of {len(data)} bytes; allowed: {8 + DIGEST} … {self._largest + DIGEST}")
        if data[:4] != self._magic:
            raise UsageError(f"not a {self._what}: it does not begin with {self._magic.decode()}")
        if _digest(data[:-DIGEST]) != data[-DIGEST:]:
            raise self._error(": damaged, its digest does not match")
        length = int.from_bytes(data[4:8], "little")
        if length > MAX_HEADER or 8 + length + DIGEST > len(data):
            raise self._error(f": header of {length} bytes in {len(data)}; allowed: {MAX_HEADER} at most")
        try:
            header = self._header.model_validate_json(data[8 : 8 + length])
        except ValidationError as error:
            raise self._error(f": {_first(error)}") from None
        return header, self._arrays(header, data, 8 + length)

    def _arrays(self, header: H, data: bytes, offset: int) -> dict[str, NDArray[Any]]:
        out: dict[str, NDArray[Any]] = {}
        end = len(data) - DIGEST
        for name, code, shape in header.arrays:
            dtype, count = _CODES[code], math.prod(shape)
            if name in out:
                raise self._error(f": {name!r} is there twice")
            if count * dtype.itemsize > end - offset:
                raise self._error(f": {name!r} {shape} is longer than the {end - offset} bytes that are left")
            try:
                array = np.frombuffer(data, dtype, count, offset).reshape(shape)
            except ValueError as error:
                raise self._error(f": {name!r} {shape}: {error}") from None
            out[name] = array
            offset += array.nbytes
        if offset != end:
            raise self._error(f": {end - offset} bytes behind the last array")
        return out

    def _error(self, text: str) -> UsageError:
        return UsageError(f"{self._what}{text}")


class Named:
    """Named arrays that are read. Every wrong name, type or shape is a UsageError; what is read are copies."""

    def __init__(self, arrays: Mapping[str, NDArray[Any]]) -> None:
        self._named = arrays
        self._read: set[str] = set()

    def __contains__(self, name: str) -> bool:
        return name in self._named

    def integer(self, name: str, largest: int) -> int:
        """A number 0 … largest."""
        value = int(self.array(name, np.int64))
        if not 0 <= value <= largest:
            raise UsageError(f"state: {name!r} is {value}; allowed: 0 … {largest}")
        return value

    def array(self, name: str, dtype: Any, *shape: int | None) -> NDArray[Any]:
        """Finite; None: any number of entries."""
        self._read.add(name)
        array = self._named.get(name)
        expected = f"{np.dtype(dtype)} {shape}"
        if array is None:
            raise UsageError(f"state: {name!r} is missing; expected {expected}")
        if array.dtype != dtype or not _fits(array.shape, shape):
            raise UsageError(f"state: {name!r} is {array.dtype} {array.shape}; expected {expected}")
        if not np.isfinite(array).all():
            raise UsageError(f"state: {name!r} holds a value that is not finite")
        return np.array(array)

    def group(self, prefix: str) -> dict[str, NDArray[Any]]:
        """Those whose names begin so, by the rest of their names, as they are."""
        names = [name for name in self._named if name.startswith(prefix)]
        self._read.update(names)
        return {name.removeprefix(prefix): np.array(self._named[name]) for name in names}

    def end(self) -> None:
        """Raises UsageError where there is what was not asked for."""
        for name in self._named:
            if name not in self._read:
                raise UsageError(f"state: unknown {name!r}{did_you_mean(name, self._read)}")


def _fits(shape: tuple[int, ...], expected: tuple[int | None, ...]) -> bool:
    return len(shape) == len(expected) and all(e in (None, s) for s, e in zip(shape, expected, strict=True))


def _digest(body: bytes) -> bytes:
    return blake2b(body, digest_size=DIGEST).digest()


def _first(error: ValidationError) -> str:
    first = error.errors(include_url=False, include_context=False, include_input=False)[0]
    return " ".join(f"{'.'.join(map(str, first['loc'])) or 'header'}: {first['msg']}".split())
