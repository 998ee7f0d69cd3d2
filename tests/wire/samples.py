"""Messages of every type, with arrays that fit, for the tests of the wire."""

from __future__ import annotations

import json
from typing import Any

import numpy as np
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from numpy.typing import NDArray

from testbed.wire.codec import Decoder, Sizes, entries_of
from testbed.wire.messages import MESSAGES, ArrayRule, Message, Packet

RUN = "run0testrun1"
SIZES = Sizes(n=2, p=1, q=3, lanes=6, steps=50)
PACKETS = sorted(name for name, model in MESSAGES.items() if issubclass(model, Packet))
OTHERS = sorted(set(MESSAGES) - set(PACKETS))

Arrays = dict[str, NDArray[Any]]
names = st.from_regex(r"\A[a-z][a-z0-9_.-]{0,63}\Z")
counts = st.integers(0, 2**63 - 1)
finite = st.floats(allow_nan=False, allow_infinity=False)


def decoder(kind: str, sizes: Sizes = SIZES) -> Decoder[Message]:
    return Decoder(MESSAGES[kind], RUN, sizes)


def shape_of(rule: ArrayRule, lanes: int, sizes: Sizes = SIZES, late: int = 2) -> tuple[int, ...]:
    free = {"lanes": lanes, "late": late}
    return tuple(free[symbol] if symbol in free else getattr(sizes, symbol) for symbol in rule.shape)


def values(rule: ArrayRule, lanes: int, late: int) -> st.SearchStrategy[NDArray[Any]]:
    shape = shape_of(rule, lanes, late=late)
    if rule.dtype == "|u1":
        return hnp.arrays(np.uint8, shape, elements=st.integers(0, 1))
    return hnp.arrays(np.float64, shape, elements=finite)


@st.composite
def packets(draw: st.DrawFn, kind: str) -> tuple[Packet, Arrays]:
    """A packet that fits, with some of its arrays in some order."""
    model = MESSAGES[kind]
    assert issubclass(model, Packet)
    lane = draw(st.integers(0, SIZES.lanes - 1))
    lanes = draw(st.integers(1, SIZES.lanes - lane))
    step = draw(st.integers(model.FIRST_STEP, SIZES.steps - 1))
    late_ones = [name for name in model.ARRAYS if name.startswith("late_")]
    present = [
        name for name, rule in model.ARRAYS.items() if name not in late_ones and (rule.required or draw(st.booleans()))
    ]
    earlier: list[int] = []
    if late_ones and step > model.FIRST_STEP and draw(st.booleans()):
        earlier = sorted(draw(st.sets(st.integers(model.FIRST_STEP, step - 1), min_size=1, max_size=3)))
        present += late_ones
    arrays = {name: draw(values(model.ARRAYS[name], lanes, len(earlier))) for name in draw(st.permutations(present))}
    if earlier:
        arrays["late_step"] = np.tile(np.array(earlier, dtype=np.float64), (lanes, 1))
    if [name for name in arrays if name not in late_ones] == ["mask"]:  # nothing of this step arrived
        arrays["mask"] = np.zeros(lanes, dtype=np.uint8)
    header = model.model_validate(
        {
            "type": kind,
            "run": RUN,
            "source": draw(names),
            "seq": draw(counts),
            "step": step,
            "lane": lane,
            "lanes": lanes,
            "arrays": entries_of(arrays),
        }
    )
    return header, arrays


@st.composite
def plain(draw: st.DrawFn, kind: str) -> tuple[Message, Arrays]:
    """A message without arrays."""
    own: dict[str, Any] = {
        "clock": {"step": draw(counts)},
        "command": {"action": "stop"},
        "change": {"step": draw(counts), "set": draw(st.dictionaries(st.text(max_size=5), finite, max_size=3))},
        "status": {
            "state": draw(st.sampled_from(["failed", "stopped"])),
            "detail": draw(st.text(st.characters(exclude_categories=["Cs"]), max_size=50)),
            "counters": draw(st.dictionaries(names, counts, max_size=3)),
            "rejected": draw(st.dictionaries(names, counts, max_size=3)),
        },
    }[kind]
    header = {"type": kind, "run": RUN, "source": draw(names), "seq": draw(counts), **own}
    return MESSAGES[kind].model_validate(header), {}


def messages(kind: str) -> st.SearchStrategy[tuple[Message, Arrays]]:
    return packets(kind) if kind in PACKETS else plain(kind)  # type: ignore[return-value]


def payload_of(header: dict[str, Any] | bytes, tail: bytes = b"") -> bytes:
    """A payload with any header, put together by hand from the description of the format."""
    text = header if isinstance(header, bytes) else json.dumps(header).encode()
    text += b" " * (-len(text) % 8)
    return b"NCS1" + len(text).to_bytes(4, "little") + text + tail


def tail_of(arrays: Arrays) -> bytes:
    """The arrays as the description of the format says."""
    out = b""
    for array in arrays.values():
        raw = array.tobytes()
        out += raw + b"\0" * (-len(raw) % 8)
    return out


def header_of(payload: bytes) -> dict[str, Any]:
    """The header as any JSON reader sees it."""
    return dict(json.loads(payload[8 : 8 + int.from_bytes(payload[4:8], "little")]))


def observation(**changes: Any) -> tuple[dict[str, Any], Arrays]:
    """A header and its arrays that fit, with some fields of the header changed."""
    arrays: Arrays = {"y": np.arange(4.0).reshape(4, 1), "mask": np.array([1, 0, 1, 1], dtype=np.uint8)}
    header = {
        "v": 1,
        "type": "observation",
        "run": RUN,
        "source": "link.observation",
        "seq": 7,
        "step": 3,
        "lane": 2,
        "lanes": 4,
        "arrays": [["y", "<f8", [4, 1]], ["mask", "|u1", [4]]],
    }
    return {**header, **changes}, arrays
