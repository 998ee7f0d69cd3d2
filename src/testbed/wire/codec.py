"""Bytes ↔ messages. Arrays are written once and read without a copy; everything is checked on the way in.

Layout: ``NCS1``, uint32 header length, JSON header padded with spaces to a multiple of 8, then the arrays one after the
other, each padded to a multiple of 8. The header starts at byte 8, so every array is aligned in the payload.
"""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Generic, TypeVar, cast

import numpy as np
from numpy.typing import NDArray
from pydantic import ValidationError

from testbed.wire.messages import PROTOCOL, ArrayEntry, Message, Packet

MAGIC = b"NCS1"
MAX_HEADER = 1 << 16
_DTYPES: dict[str, np.dtype[Any]] = {"<f8": np.dtype("<f8"), "|u1": np.dtype("u1")}
_PADDING = (b"", b"\0" * 7, b"\0" * 6, b"\0" * 5, b"\0" * 4, b"\0" * 3, b"\0" * 2, b"\0")

M = TypeVar("M", bound=Message)
Arrays = Mapping[str, NDArray[Any]]


class Rejected(ValueError):
    """A payload that is not a valid message here. ``reason`` is one of a few short words, for counting."""

    def __init__(self, reason: str, detail: str) -> None:
        super().__init__(f"{reason}: {detail}")
        self.reason = reason


@dataclass(frozen=True)
class Sizes:
    """The sizes that a run's packets must have; ``lanes_per_packet``: how the lanes are split, None for any split."""

    n: int
    p: int
    q: int
    lanes: int
    steps: int
    lanes_per_packet: int | None = None


def entries_of(arrays: Arrays) -> tuple[ArrayEntry, ...]:
    return tuple((name, _code(array), array.shape) for name, array in arrays.items())


def encode(message: Message, arrays: Arrays | None = None) -> bytes:
    """The payload of a message; the ``arrays`` field of a packet must list what is in ``arrays``, in that order.

    Arrays: float64 or uint8, any layout.
    """
    return _joined(type(message).__pydantic_serializer__.to_json(message), arrays or {})


class PacketEncoder:
    """``encode`` for the packets of one type on one key, with the constant part of the header written once."""

    def __init__(self, model: type[Packet], run: str, source: str) -> None:
        kind = model.model_fields["type"].default
        model.model_validate({"type": kind, "run": run, "source": source, "seq": 0, "step": 0, "lane": 0, "lanes": 1})
        self._head = f'{{"v":{PROTOCOL},"type":"{kind}","run":"{run}","source":"{source}","seq":'
        self._lists: dict[tuple[tuple[str, tuple[int, ...]], ...], str] = {}

    def encode(self, seq: int, step: int, lane: int, lanes: int, arrays: Arrays) -> bytes:
        """The payload of one packet; arrays: float64 or uint8."""
        shapes = tuple((name, array.shape) for name, array in arrays.items())
        listed = self._lists.get(shapes)
        if listed is None:
            listed = self._lists[shapes] = json.dumps(entries_of(arrays), separators=(",", ":"))
        header = f'{self._head}{seq},"step":{step},"lane":{lane},"lanes":{lanes},"arrays":{listed}}}'
        return _joined(header.encode(), arrays)


def _joined(header: bytes, arrays: Arrays) -> bytes:
    pieces: list[bytes | memoryview] = [
        MAGIC,
        (len(header) + -len(header) % 8).to_bytes(4, "little"),
        header,
        b" " * (-len(header) % 8),
    ]
    for array in arrays.values():
        pieces.append(array.data if array.flags.c_contiguous and array.size else array.tobytes())
        if array.nbytes % 8:
            pieces.append(_PADDING[array.nbytes % 8])
    return b"".join(pieces)


class Decoder(Generic[M]):
    """Reads messages of one type of one run."""

    def __init__(self, model: type[M], run: str, sizes: Sizes) -> None:
        self._model, self._run, self._sizes = model, run, sizes
        self._validate = model.__pydantic_validator__.validate_json
        self._required = {name for name, rule in model.ARRAYS.items() if rule.required}

    def decode(self, payload: bytes) -> tuple[M, dict[str, NDArray[Any]]]:
        """The header and its arrays, read-only views of the payload.

        Raises Rejected: not a message, wrong type or version, another run, a step or lane out of range, arrays that the
        type does not have or that lack, wrong shape or length, values that are not finite, masks other than 0 and 1.
        """
        if payload[:4] != MAGIC:
            raise Rejected("format", "the payload does not begin with NCS1")
        length = int.from_bytes(payload[4:8], "little")
        if length > MAX_HEADER or length % 8 or 8 + length > len(payload):
            raise Rejected("format", f"header of {length} bytes in a payload of {len(payload)}")
        try:
            header = cast(M, self._validate(payload[8 : 8 + length]))
        except ValidationError as error:
            raise Rejected("schema", _first_error(error)) from None
        if not header.model_fields_set >= header.ALWAYS:
            raise Rejected("schema", f"{', '.join(sorted(header.ALWAYS - header.model_fields_set))}: Field required")
        if header.run != self._run:
            raise Rejected("run", f"of run {header.run}, this is {self._run}")
        if not isinstance(header, Packet):
            if len(payload) != 8 + length:
                raise Rejected("format", f"{len(payload) - 8 - length} bytes behind a header without arrays")
            return header, {}
        past = header.step - header.FIRST_STEP
        if not 0 <= past < self._sizes.steps or header.lane + header.lanes > self._sizes.lanes:
            raise Rejected("range", f"step {header.step}, lanes {header.lane}…{header.lane + header.lanes - 1}")
        return header, self._arrays(header, payload, 8 + length)

    def _arrays(self, header: Packet, payload: bytes, offset: int) -> dict[str, NDArray[Any]]:
        rules, out = self._model.ARRAYS, {}
        for name, code, shape in header.arrays:
            rule = rules.get(name)
            if rule is None or name in out:
                raise Rejected("arrays", f"array {name!r} not expected")
            if code != rule.dtype or shape != self._shape(rule.shape, header.lanes):
                raise Rejected("shape", f"{name} is {code} {shape}, expected {rule.dtype} {rule.shape}")
            count = math.prod(shape)
            size = count * (8 if code == "<f8" else 1)
            if offset + size > len(payload):
                raise Rejected("format", f"payload of {len(payload)} bytes ends inside {name}")
            flat = np.frombuffer(payload, _DTYPES[code], count, offset)
            if code == "<f8":
                if not all_finite(flat):
                    raise Rejected("finite", f"{name} holds a value that is not finite")
            elif count and flat.max() > 1:
                raise Rejected("mask", f"{name} holds a value other than 0 and 1")
            out[name] = flat.reshape(shape)
            offset += size + -size % 8
        if offset != len(payload):
            raise Rejected("format", f"payload of {len(payload)} bytes, arrays end at {offset}")
        if not self._required <= out.keys():
            raise Rejected("arrays", f"missing {', '.join(sorted(self._required - out.keys()))}")
        if len(out) == 1 and "mask" in out and out["mask"].any():
            raise Rejected("arrays", "the mask says that something arrived and nothing is there")
        return out

    def _shape(self, symbols: tuple[str, ...], lanes: int) -> tuple[int, ...]:
        return tuple(lanes if s == "lanes" else getattr(self._sizes, s) for s in symbols)


def all_finite(x: NDArray[np.float64]) -> bool:
    """Whether every entry of a flat array is finite, reading each once in the common case.

    The product of the two halves is finite only if every factor is; if it is not, it may be an overflow: look closely.
    vdot, unlike dot, does not warn of that.
    """
    half = len(x) // 2
    if len(x) > 1 and math.isfinite(np.vdot(x[:half], x[half : 2 * half])):
        return len(x) % 2 == 0 or math.isfinite(x[-1])
    return bool(np.isfinite(x).all())


def _code(array: NDArray[Any]) -> Any:
    if array.dtype == _DTYPES["<f8"]:
        return "<f8"
    if array.dtype == _DTYPES["|u1"]:
        return "|u1"
    raise TypeError(f"arrays of a message are float64 or uint8, not {array.dtype}")


def _first_error(error: ValidationError) -> str:
    first = error.errors(include_url=False, include_context=False, include_input=False)[0]
    return f"{'.'.join(map(str, first['loc'])) or 'header'}: {first['msg']}"
