"""Bytes ↔ messages. Arrays are written once and read without a copy; everything is checked on the way in.

Layout: ``NCS1``, uint32 header length, JSON header padded with spaces to a multiple of 8, then the arrays one after the
other, each padded to a multiple of 8. The header starts at byte 8, so every array is aligned in the payload.
"""

from __future__ import annotations

import json
import math
import re
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any, Generic, TypeVar, cast

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ValidationError

from testbed.wire.bundle import unbundle
from testbed.wire.messages import PROTOCOL, ArrayEntry, Message, Packet

MAGIC = b"NCS1"
MAX_HEADER = 1 << 16
_FLOAT = np.dtype("<f8")
_DTYPES: dict[str, np.dtype[Any]] = {"<f8": _FLOAT, "|u1": np.dtype("u1")}
_FORMS_MAX = 64
_FEW = 16  # numbers up to which looking at each in turn is fastest
_NUMBER = rb" *(0|[1-9][0-9]{0,17})"
_SEQ = b'"seq":'
_NUMBERS = re.compile(_NUMBER + rb',"step":' + _NUMBER)
_VARIABLE = re.compile(
    _NUMBERS.pattern + rb',"lane":' + _NUMBER + rb',"lanes":([1-9][0-9]{0,8})(,"arrays":[^{}:]*\}) *'
)
"""What follows ``"seq":`` in a header as PacketEncoder writes it; what comes before is the same for all on a key.

No key follows ``arrays``: of a key that is there twice the last counts.
"""
_SMALL = 1024  # bytes up to which copying an array twice costs less than a view of it
_PADDING = (b"", b"\0" * 7, b"\0" * 6, b"\0" * 5, b"\0" * 4, b"\0" * 3, b"\0" * 2, b"\0")

M = TypeVar("M", bound=Message)
Arrays = Mapping[str, NDArray[Any]]
Content = dict[str, NDArray[Any]]


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
    """``encode`` for the packets of one type on one key, with the constant parts of the header written once.

    The numbers are set off with blanks, so that the packets of a block of lanes all have the same length.
    """

    def __init__(self, model: type[Packet], run: str, source: str) -> None:
        kind = model.model_fields["type"].default
        model.model_validate({"type": kind, "run": run, "source": source, "seq": 0, "step": 0, "lane": 0, "lanes": 1})
        self._head = f'{{"v":{PROTOCOL},"type":"{kind}","run":"{run}","source":"{source}","seq":'.encode()
        self._parts: dict[tuple[Any, ...], tuple[bytes, bytes]] = {}

    def encode(self, seq: int, step: int, lane: int, lanes: int, arrays: Arrays) -> bytes:
        """The payload of one packet; arrays: float64 or uint8."""
        numbers = _text(seq, step)
        form = (len(numbers), lane, lanes, *[(name, array.shape, array.dtype) for name, array in arrays.items()])
        parts = self._parts.get(form)
        if parts is None:
            parts = self._parts[form] = self._written(len(numbers), lane, lanes, arrays)
        return b"".join([parts[0], numbers, parts[1], *_contents(arrays)])

    def _written(self, width: int, lane: int, lanes: int, arrays: Arrays) -> tuple[bytes, bytes]:
        """What stands before and behind the numbers."""
        listed = json.dumps(entries_of(arrays), separators=(",", ":"))
        tail = f',"lane":{lane},"lanes":{lanes},"arrays":{listed}}}'.encode()
        length = len(self._head) + width + len(tail)
        blanks = -length % 8
        return MAGIC + (length + blanks).to_bytes(4, "little") + self._head, tail + b" " * blanks


def _joined(header: bytes, arrays: Arrays) -> bytes:
    blanks = -len(header) % 8
    return b"".join([MAGIC, (len(header) + blanks).to_bytes(4, "little"), header, b" " * blanks, *_contents(arrays)])


def _contents(arrays: Arrays) -> list[bytes | memoryview]:
    """The bytes of the arrays, each padded."""
    pieces: list[bytes | memoryview] = []
    for array in arrays.values():
        size = array.nbytes
        pieces.append(array.tobytes() if size < _SMALL or not array.flags.c_contiguous else array.data)
        if size % 8:
            pieces.append(_PADDING[size % 8])
    return pieces


def _text(seq: int, step: int) -> bytes:
    """How PacketEncoder writes the numbers."""
    return b'%12d,"step":%12d' % (seq, step)


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
    """The arrays of a packet and the bytes they take; ``bare_mask``: of this step a mask and nothing else."""

    slots: tuple[_Slot, ...]
    size: int
    bare_mask: bool
    late: bool


@dataclass(frozen=True)
class _Form:
    """A header that was found valid, with its layout; others differ from it in seq, step and lane only."""

    header: Any
    layout: _Layout


@dataclass(frozen=True)
class _Recent:
    """The last packet that was found valid: what stands before and behind seq and step in it."""

    form: _Form
    head: bytes
    tail: bytes
    tail_at: int
    end: int
    """Where the arrays begin."""

    def numbers(self, message: bytes) -> tuple[int, int] | None:
        """(seq, step) of a message whose header differs from this one in these only."""
        if not message.startswith(self.head) or not message.startswith(self.tail, self.tail_at):
            return None
        match = _NUMBERS.fullmatch(message, len(self.head), self.tail_at)
        return None if match is None else (int(match[1]), int(match[2]))

    def numbers_of(self, messages: list[bytes]) -> list[tuple[int, int] | None]:
        """``numbers`` of each: most often both are one more than in the message before."""
        out: list[tuple[int, int] | None] = []
        seq, step = self.numbers(messages[0]) or (0, 0)
        tail, tail_at = self.tail, self.tail_at
        for message in messages:
            expected = self.head + _text(seq, step)
            if message.startswith(expected) and len(expected) == tail_at and message.startswith(tail, tail_at):
                out.append((seq, step))
            else:
                found = self.numbers(message)
                out.append(found)
                seq, step = found or (seq, step)
            seq, step = seq + 1, step + 1
        return out


_new = object.__new__
_slots = vars(BaseModel)
_set_values, _set_named = _slots["__dict__"].__set__, _slots["__pydantic_fields_set__"].__set__
_set_extra, _set_private = _slots["__pydantic_extra__"].__set__, _slots["__pydantic_private__"].__set__


def _variant(header: Any, seq: int, step: int, lane: int) -> Any:
    """A valid header with other numbers, which the caller has checked; model_copy takes ten times as long."""
    out, values = _new(type(header)), header.__dict__.copy()
    values["seq"], values["step"], values["lane"] = seq, step, lane
    _set_values(out, values)
    _set_named(out, header.__pydantic_fields_set__)
    _set_extra(out, None)
    _set_private(out, None)
    return out


class Decoder(Generic[M]):
    """Reads messages of one type of one run."""

    def __init__(self, model: type[M], run: str, sizes: Sizes) -> None:
        self._model, self._run, self._sizes = model, run, sizes
        self._validate = model.__pydantic_validator__.validate_json
        self._forms: dict[tuple[bytes | Any, ...], _Form] = {}
        self._recent: dict[int, _Recent] = {}
        self._required = {name for name, rule in model.ARRAYS.items() if rule.required}

    def read(self, payload: bytes) -> Iterable[tuple[bytes, tuple[M, Content] | Rejected]]:
        """The messages of a payload, which may be a bundle, each with what ``decode`` says of it."""
        messages = unbundle(payload)
        if len(messages) == 1:
            return ((payload, self._outcome(payload)),)
        groups: dict[int, list[int]] = {}
        for i, message in enumerate(messages):
            groups.setdefault(len(message), []).append(i)
        outcomes: list[Any] = [None] * len(messages)
        for places in groups.values():
            group = [messages[i] for i in places]
            for i, outcome in zip(places, self._alike(group) or map(self._outcome, group), strict=True):
                outcomes[i] = outcome
        return zip(messages, outcomes, strict=True)

    def _outcome(self, message: bytes) -> tuple[M, Content] | Rejected:
        try:
            return self.decode(message)
        except Rejected as refusal:
            return refusal

    def decode(self, payload: bytes) -> tuple[M, Content]:
        """The header of a message and its arrays, read-only views of the payload.

        Raises Rejected: not a message, wrong type or version, another run, a step or lane out of range, arrays that the
        type does not have or that lack, wrong shape or length, values that are not finite, masks other than 0 and 1.
        """
        recent = self._recent.get(len(payload))
        if recent is not None and (numbers := recent.numbers(payload)) is not None:
            header = _variant(recent.form.header, *numbers, recent.form.header.lane)
            self._check_range(header)
            return header, self._content(header, recent.form.layout, payload, recent.end)
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
            header = _variant(form.header, int(seq), int(step), int(lane))
            self._check_range(header)
            arrays = self._content(header, form.layout, payload, 8 + length)
        else:
            header = self._valid(payload[8 : 8 + length])
            if not isinstance(header, Packet):
                if len(payload) != 8 + length:
                    raise Rejected("format", f"{len(payload) - 8 - length} bytes behind a header without arrays")
                return header, {}
            self._check_range(header)
            form = _Form(header, self._layout(header.arrays, header.lanes))
            if match is not None and len(self._forms) < _FORMS_MAX:
                self._forms[key] = form
            arrays = self._content(header, form.layout, payload, 8 + length)
        if match is not None:
            tail_at = match.end(2)
            tail = payload[tail_at : 8 + length]
            recent = _Recent(_Form(header, form.layout), payload[:numbers_at], tail, tail_at, 8 + length)
            if len(self._recent) >= _FORMS_MAX:
                self._recent.clear()
            self._recent[len(payload)] = recent
        return header, arrays

    def _valid(self, text: bytes) -> M:
        """A header as its model wants it."""
        try:
            header = cast(M, self._validate(text))
        except ValidationError as error:
            raise Rejected("schema", _first_error(error)) from None
        if not header.model_fields_set >= header.ALWAYS:
            raise Rejected("schema", f"{', '.join(sorted(header.ALWAYS - header.model_fields_set))}: Field required")
        if header.run != self._run:
            raise Rejected("run", f"of run {header.run}, this is {self._run}")
        return header

    def _alike(self, messages: list[bytes]) -> list[tuple[M, Content]] | None:
        """All messages of one length at once, where they differ in seq, step and values only and all are valid."""
        if isinstance(self._outcome(messages[0]), Rejected):
            return None
        size, recent = len(messages[0]), self._recent.get(len(messages[0]))
        if recent is None:
            return None
        like, layout = recent.form.header, recent.form.layout
        if not layout.slots or layout.late or size != recent.end + layout.size:
            return None
        numbers = recent.numbers_of(messages)
        first, last = like.FIRST_STEP, like.FIRST_STEP + self._sizes.steps - 1
        if not all(pair is not None and first <= pair[1] <= last for pair in numbers):
            return None
        whole = b"".join(messages)
        columns = []
        for slot in layout.slots:
            shape, strides = (len(messages), slot.count), (size, slot.dtype.itemsize)
            column = np.ndarray(shape, slot.dtype, whole, recent.end + slot.offset, strides)
            valid = np.isfinite(column).all() if slot.dtype is _FLOAT else not (column > 1).any()
            if not valid or (layout.bare_mask and column.any()):
                return None
            columns.append(column.reshape(len(messages), *slot.shape))
        names = [slot.name for slot in layout.slots]
        rows = zip(*columns, strict=True)
        headers = [_variant(like, *pair, like.lane) for pair in numbers if pair is not None]
        return [(header, dict(zip(names, row, strict=True))) for header, row in zip(headers, rows, strict=True)]

    def _check_range(self, header: Packet) -> None:
        past = header.step - header.FIRST_STEP
        if not 0 <= past < self._sizes.steps or header.lane + header.lanes > self._sizes.lanes:
            raise Rejected("range", f"step {header.step}, lanes {header.lane}…{header.lane + header.lanes - 1}")

    def _content(self, header: Packet, layout: _Layout, payload: bytes, offset: int) -> Content:
        arrays = self._arrays(layout, payload, offset)
        if layout.late:
            self._check_late(header, arrays)
        return arrays

    def _arrays(self, layout: _Layout, payload: bytes, offset: int) -> Content:
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

    def _check_late(self, header: Packet, arrays: Content) -> None:
        """Whether late arrays belong to earlier steps, the same in all lanes."""
        steps = arrays["late_step"]
        first = steps[0]
        if (steps != first).any() or (first != np.floor(first)).any():
            raise Rejected("range", "late_step is not the same whole number in all lanes")
        if first.min() < header.FIRST_STEP or first.max() >= header.step or (np.diff(first) <= 0).any():
            raise Rejected("range", f"late_step {first.tolist()} in step {header.step}: not earlier, or not in order")

    def _layout(self, arrays: tuple[ArrayEntry, ...], lanes: int) -> _Layout:
        """Where the arrays that a header lists lie. Raises Rejected for a list that the type does not allow."""
        slots: list[_Slot] = []
        offset, late = 0, None
        for name, code, shape in arrays:
            rule = self._model.ARRAYS.get(name)
            if rule is None or any(slot.name == name for slot in slots):
                raise Rejected("arrays", f"array {name!r} not expected")
            if "late" in rule.shape and len(shape) == len(rule.shape):
                late = shape[rule.shape.index("late")] if late is None else late
            if code != rule.dtype or shape != self._shape(rule.shape, lanes, late or 0):
                raise Rejected("shape", f"{name} is {code} {shape}, expected {rule.dtype} {rule.shape}")
            slots.append(_Slot(name, _DTYPES[code], math.prod(shape), shape, offset))
            size = slots[-1].count * _DTYPES[code].itemsize
            offset += size + -size % 8
        names = {slot.name for slot in slots}
        if not self._required <= names:
            raise Rejected("arrays", f"missing {', '.join(sorted(self._required - names))}")
        if late is not None:
            lacking = {name for name, rule in self._model.ARRAYS.items() if "late" in rule.shape} - names
            if lacking or not 1 <= late <= self._sizes.steps:
                raise Rejected("arrays", f"{late} late ones, missing {', '.join(sorted(lacking)) or 'none'}")
            names = {name for name in names if "late" not in self._model.ARRAYS[name].shape}
        return _Layout(tuple(slots), offset, names == {"mask"}, late is not None)

    def _shape(self, symbols: tuple[str, ...], lanes: int, late: int) -> tuple[int, ...]:
        free = {"lanes": lanes, "late": late}
        return tuple(free[s] if s in free else getattr(self._sizes, s) for s in symbols)


def all_finite(x: NDArray[np.float64]) -> bool:
    """Whether every entry of an array is finite, reading each once in the common case.

    The product of the two halves is finite only if every factor is; if it is not, it may be an overflow: look closely.
    vdot, unlike dot, does not warn of that.
    """
    x = x.reshape(-1)
    if len(x) <= _FEW:
        return math.isfinite(sum(x.tolist())) or bool(np.isfinite(x).all())
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
