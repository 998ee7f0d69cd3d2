"""Bytes ↔ messages. Arrays are written once and read without a copy; everything is checked on the way in.

Layout: ``NCS1``, uint32 header length, JSON header padded with spaces to a multiple of 8, then the arrays one after the
other, each padded to a multiple of 8. The header starts at byte 8, so every array is aligned in the payload.
"""

from __future__ import annotations

import json
import math
import re
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Generic, TypeVar, cast

import numpy as np
from numpy.typing import NDArray
from pydantic import ValidationError

from testbed.wire.messages import PROTOCOL, ArrayEntry, Message, Packet

MAGIC = b"NCS1"
MAX_HEADER = 1 << 16
_FLOAT = np.dtype("<f8")
_DTYPES: dict[str, np.dtype[Any]] = {"<f8": _FLOAT, "|u1": np.dtype("u1")}
_FORMS_MAX = 64
_FEW = 16  # numbers up to which looking at each in turn is fastest
_NUMBER = rb"(0|[1-9][0-9]{0,17})"
_SEQ = b'"seq":'
_VARIABLE = re.compile(
    _NUMBER + rb',"step":' + _NUMBER + rb',"lane":' + _NUMBER + rb',"lanes":([1-9][0-9]{0,8})(,"arrays":[^{}:]*\}) *'
)
"""What follows ``"seq":`` in a header as PacketEncoder writes it; what comes before is the same for all on a key.

No key follows ``arrays``: of a key that is there twice the last counts.
"""
_SMALL = 1024  # bytes up to which copying an array twice costs less than a view of it
_BLANKS = tuple(b" " * n for n in range(8))
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
        self._tails: dict[tuple[tuple[str, tuple[int, ...]], ...], str] = {}

    def encode(self, seq: int, step: int, lane: int, lanes: int, arrays: Arrays) -> bytes:
        """The payload of one packet; arrays: float64 or uint8."""
        shapes = tuple([(name, array.shape) for name, array in arrays.items()])
        tail = self._tails.get(shapes)
        if tail is None:
            listed = json.dumps(entries_of(arrays), separators=(",", ":"))
            tail = self._tails[shapes] = f',"arrays":{listed}}}'
        return _joined(f'{self._head}{seq},"step":{step},"lane":{lane},"lanes":{lanes}{tail}'.encode(), arrays)


def _joined(header: bytes, arrays: Arrays) -> bytes:
    blanks = -len(header) % 8
    pieces: list[bytes | memoryview] = [MAGIC, (len(header) + blanks).to_bytes(4, "little"), header, _BLANKS[blanks]]
    for array in arrays.values():
        content = array.tobytes() if array.nbytes < _SMALL or not array.flags.c_contiguous else array.data
        pieces.append(content)
        if array.nbytes % 8:
            pieces.append(_PADDING[array.nbytes % 8])
    return b"".join(pieces)


@dataclass(frozen=True)
class _Slot:
    """One array of a layout; ``offset`` from the end of the header."""

    name: str
    dtype: np.dtype[Any]
    count: int
    shape: tuple[int, ...]
    offset: int


@dataclass(frozen=True)
class _Layout:
    """The arrays of a packet and the bytes they take; ``bare_mask``: a mask and nothing else."""

    slots: tuple[_Slot, ...]
    size: int
    bare_mask: bool


@dataclass(frozen=True)
class _Form:
    """A header that was found valid, with its layout; others differ from it in seq, step and lane only."""

    header: Any
    layout: _Layout


_set = object.__setattr__


def _variant(header: Any, seq: int, step: int, lane: int) -> Any:
    """A valid header with other numbers, which the caller has checked; model_copy takes ten times as long."""
    out = object.__new__(type(header))
    _set(out, "__dict__", {**header.__dict__, "seq": seq, "step": step, "lane": lane})
    _set(out, "__pydantic_fields_set__", header.__pydantic_fields_set__)
    _set(out, "__pydantic_extra__", None)
    _set(out, "__pydantic_private__", None)
    return out


class Decoder(Generic[M]):
    """Reads messages of one type of one run."""

    def __init__(self, model: type[M], run: str, sizes: Sizes) -> None:
        self._model, self._run, self._sizes = model, run, sizes
        self._validate = model.__pydantic_validator__.validate_json
        self._forms: dict[tuple[bytes | Any, ...], _Form] = {}
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
        numbers_at = payload.find(_SEQ, 8, 8 + length) + len(_SEQ)
        match = _VARIABLE.fullmatch(payload, numbers_at, 8 + length) if numbers_at >= len(_SEQ) else None
        key = (payload[8:numbers_at], *match.group(4, 5)) if match is not None else ()
        form = self._forms.get(key)
        if match is not None and form is not None:
            seq, step, lane = match.group(1, 2, 3)
            variant = _variant(form.header, int(seq), int(step), int(lane))
            self._check_range(variant)
            return variant, self._arrays(form.layout, payload, 8 + length)
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
        self._check_range(header)
        layout = self._layout(header.arrays, header.lanes)
        if match is not None and len(self._forms) < _FORMS_MAX:
            self._forms[key] = _Form(header, layout)
        return header, self._arrays(layout, payload, 8 + length)

    def _check_range(self, header: Packet) -> None:
        past = header.step - header.FIRST_STEP
        if not 0 <= past < self._sizes.steps or header.lane + header.lanes > self._sizes.lanes:
            raise Rejected("range", f"step {header.step}, lanes {header.lane}…{header.lane + header.lanes - 1}")

    def _arrays(self, layout: _Layout, payload: bytes, offset: int) -> dict[str, NDArray[Any]]:
        if len(payload) != offset + layout.size:
            raise Rejected("format", f"payload of {len(payload)} bytes, its arrays need {offset + layout.size}")
        out = {}
        for slot in layout.slots:
            flat = np.frombuffer(payload, slot.dtype, slot.count, offset + slot.offset)
            if slot.dtype is _FLOAT:
                if not all_finite(flat):
                    raise Rejected("finite", f"{slot.name} holds a value that is not finite")
            elif slot.count and (flat[0] if slot.count == 1 else flat.max()) > 1:
                raise Rejected("mask", f"{slot.name} holds a value other than 0 and 1")
            out[slot.name] = flat.reshape(slot.shape)
        if layout.bare_mask and out["mask"].any():
            raise Rejected("arrays", "the mask says that something arrived and nothing is there")
        return out

    def _layout(self, arrays: tuple[ArrayEntry, ...], lanes: int) -> _Layout:
        """Where the arrays that a header lists lie. Raises Rejected for a list that the type does not allow."""
        slots: list[_Slot] = []
        offset = 0
        for name, code, shape in arrays:
            rule = self._model.ARRAYS.get(name)
            if rule is None or any(slot.name == name for slot in slots):
                raise Rejected("arrays", f"array {name!r} not expected")
            if code != rule.dtype or shape != self._shape(rule.shape, lanes):
                raise Rejected("shape", f"{name} is {code} {shape}, expected {rule.dtype} {rule.shape}")
            slots.append(_Slot(name, _DTYPES[code], math.prod(shape), shape, offset))
            size = slots[-1].count * _DTYPES[code].itemsize
            offset += size + -size % 8
        names = {slot.name for slot in slots}
        if not self._required <= names:
            raise Rejected("arrays", f"missing {', '.join(sorted(self._required - names))}")
        return _Layout(tuple(slots), offset, names == {"mask"})

    def _shape(self, symbols: tuple[str, ...], lanes: int) -> tuple[int, ...]:
        return tuple(lanes if s == "lanes" else getattr(self._sizes, s) for s in symbols)


def all_finite(x: NDArray[np.float64]) -> bool:
    """Whether every entry of a flat array is finite, reading each once in the common case.

    The product of the two halves is finite only if every factor is; if it is not, it may be an overflow: look closely.
    vdot, unlike dot, does not warn of that.
    """
    if len(x) <= _FEW:
        return all(map(math.isfinite, x.tolist()))
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
