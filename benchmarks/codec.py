"""Encoding and decoding an estimate: one lane against other codecs, 1 MB against a copy of as many bytes."""

from __future__ import annotations

import json
import struct
import time
from collections.abc import Callable
from typing import Any

import numpy as np
from pydantic import BaseModel, ConfigDict

from benchmarks.figures import Figures, Median, Target
from testbed.wire.codec import Decoder, PacketEncoder, Sizes
from testbed.wire.messages import EstimateMessage

RUN, SOURCE, N = "0123456789ab", "estimator.aoe", 2
_HEAD = struct.Struct("<4sHHQQII")


class _AllJson(BaseModel):
    """The same message with its arrays as JSON numbers."""

    model_config = ConfigDict(frozen=True, extra="forbid", strict=True)

    v: int
    type: str
    run: str
    source: str
    seq: int
    step: int
    lane: int
    lanes: int
    x_hat: list[list[float]]
    P: list[list[list[float]]]


def run(*, quick: bool) -> Figures:
    rounds = 30 if quick else 200
    figures = Figures("codec")
    one = _small(figures, rounds)
    ratio = _large(figures, rounds)
    figures.targets.append(Target("µs to encode and decode one lane of 2 states", one, 10.0, at_least=False))
    figures.targets.append(Target("1 MB: encode + decode / copy", ratio, 1.5, at_least=False))
    figures.notes.append("best and median of many rounds; the targets judge the medians")
    return figures


def _small(figures: Figures, rounds: int) -> float:
    arrays = {"x_hat": np.array([[1.25, -2.5]]), "P": np.array([[[2.0, 0.5], [0.5, 1.0]]])}
    cases = {name: codec(arrays) for name, codec in (("testbed", _ours), ("pydantic JSON", _json), ("struct", _struct))}
    calls: dict[str, Callable[[], Any]] = {}
    for name, (encode, decode) in cases.items():
        payload = encode()
        calls[f"{name} encode"], calls[f"{name} decode"] = encode, _with(decode, payload)
    times = _timed(calls, rounds, loops=300)
    for name in cases:
        row: dict[str, Any] = {"case": f"1 lane, {name}", "bytes": len(cases[name][0]())}
        for part in ("encode", "decode"):
            row[f"{part} µs"] = _best_and_median(times[f"{name} {part}"])
        both = [a + b for a, b in zip(times[f"{name} encode"], times[f"{name} decode"], strict=True)]
        figures.rows.append({**row, "both µs": _best_and_median(both)})
    return Median.of([a + b for a, b in zip(times["testbed encode"], times["testbed decode"], strict=True)]).value


def _large(figures: Figures, rounds: int) -> float:
    lanes = 1_000_000 // (8 * (N + N * N))
    arrays = {"x_hat": np.random.default_rng(1).normal(size=(lanes, N)), "P": np.ones((lanes, N, N))}
    encode, decode = _ours(arrays)
    payload = encode()
    source = memoryview(bytearray(payload))
    times = _timed({"encode": encode, "decode": _with(decode, payload), "copy": _with(bytes, source)}, rounds, loops=5)
    both = [a + b for a, b in zip(times["encode"], times["decode"], strict=True)]
    row: dict[str, Any] = {"case": f"{lanes} lanes, testbed", "bytes": len(payload)}
    row |= {f"{part} µs": _best_and_median(times[part]) for part in ("encode", "decode")}
    figures.rows.append({**row, "both µs": _best_and_median(both)})
    figures.rows.append(
        {"case": "bytes(buffer) of that size", "bytes": len(payload), "both µs": _best_and_median(times["copy"])}
    )
    parts = {"encode": times["encode"], "decode": times["decode"], "both": both}
    ratios = {name: Median.of([a / b for a, b in zip(t, times["copy"], strict=True)]) for name, t in parts.items()}
    best = min(both) / min(times["copy"])
    shown = ", ".join(f"{name} {ratio}" for name, ratio in ratios.items())
    figures.notes.append(f"1 MB, ratio to the copy beside it: {shown}; best of both / best copy {best:.3g}")
    return ratios["both"].value


def _ours(arrays: dict[str, Any]) -> tuple[Callable[[], bytes], Callable[[bytes], Any]]:
    lanes = len(arrays["x_hat"])
    encoder = PacketEncoder(EstimateMessage, RUN, SOURCE)
    decoder = Decoder(EstimateMessage, RUN, Sizes(n=N, p=N, q=1, lanes=lanes, steps=10_000))
    return lambda: encoder.encode(1000, 1000, 0, lanes, arrays), decoder.decode


def _json(arrays: dict[str, Any]) -> tuple[Callable[[], bytes], Callable[[bytes], Any]]:
    def encode() -> bytes:
        lists = {name: array.tolist() for name, array in arrays.items()}
        head = {"v": 1, "type": "estimate", "run": RUN, "source": SOURCE, "seq": 1000, "step": 1000, "lane": 0}
        return _AllJson(**head, lanes=1, **lists).model_dump_json().encode()  # type: ignore[arg-type]

    def decode(payload: bytes) -> Any:
        message = _AllJson.model_validate_json(payload)
        return message, np.array(message.x_hat), np.array(message.P)

    assert json.loads(encode())["x_hat"] == arrays["x_hat"].tolist()
    return encode, decode


def _struct(arrays: dict[str, Any]) -> tuple[Callable[[], bytes], Callable[[bytes], Any]]:
    """By hand, with next to no checks."""

    def encode() -> bytes:
        head = _HEAD.pack(b"NCS1", 1, 5, 1000, 1000, 0, 1)
        return head + arrays["x_hat"].tobytes() + arrays["P"].tobytes()

    def decode(payload: bytes) -> Any:
        magic, _, _, seq, step, lane, lanes = _HEAD.unpack_from(payload)
        if magic != b"NCS1":
            raise ValueError(magic)
        x_hat = np.frombuffer(payload, "<f8", lanes * N, _HEAD.size).reshape(lanes, N)
        covariance = np.frombuffer(payload, "<f8", lanes * N * N, _HEAD.size + x_hat.nbytes).reshape(lanes, N, N)
        return seq, step, lane, x_hat, covariance

    return encode, decode


def _timed(calls: dict[str, Callable[[], Any]], rounds: int, loops: int) -> dict[str, list[float]]:
    """µs a call, of every round; the calls alternate."""
    out: dict[str, list[float]] = {name: [] for name in calls}
    for _ in range(rounds):
        for name, call in calls.items():
            begun = time.perf_counter()
            for _ in range(loops):
                call()
            out[name].append((time.perf_counter() - begun) / loops * 1e6)
    return out


def _with(function: Callable[[Any], Any], argument: Any) -> Callable[[], Any]:
    return lambda: function(argument)


def _best_and_median(values: list[float]) -> str:
    return f"{min(values):.3g} / {Median.of(values).value:.3g}"
