"""PACKETS.jsonl: what an estimator received, a line a step; and an estimator run over it, without a network."""

from __future__ import annotations

import json
from collections.abc import Iterable, Iterator
from typing import Annotated, Any

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, FiniteFloat, ValidationError

from testbed.errors import RunFailed, TestbedError, UsageError
from testbed.estimator.model import Ack, Estimator, Model, seen
from testbed.estimator.refilter import LateObservation, Refilter

Bit = Annotated[int, Field(ge=0, le=1)]


class PacketLine(BaseModel):
    """One line of PACKETS.jsonl."""

    model_config = ConfigDict(frozen=True, extra="forbid", strict=True)

    k: Annotated[int, Field(ge=1, description="step, 1, 2, … without gaps")]
    u: Annotated[list[FiniteFloat] | None, Field(description="u_{k−1} as sent")] = None
    y: Annotated[list[FiniteFloat] | None, Field(description="y_k; null: nothing arrived")] = None
    gamma: Annotated[
        Bit | None,
        Field(description="1 where y is given; 0 with a y: the packet carried only noise"),
    ] = None
    acks: Annotated[
        list[tuple[Annotated[int, Field(ge=0)], Bit]] | None,
        Field(description="[j, ν_j] that became known at this step"),
    ] = None
    late: Annotated[
        list[tuple[Annotated[int, Field(ge=1)], list[FiniteFloat]]] | None,
        Field(description="[j, y_j] of earlier steps j that came since the last step"),
    ] = None


def read_packets(lines: Iterable[str], model: Model) -> Iterator[PacketLine]:
    """The lines of a file, checked. Raises UsageError that names the line."""
    expected = 1
    for number, text in enumerate(lines, start=1):
        if not text.strip():
            continue
        try:
            line = PacketLine.model_validate_json(text)
            _check(line, expected, model)
        except ValidationError as error:
            first = error.errors(include_url=False, include_context=False)[0]
            where = ".".join(map(str, first["loc"])) or "line"
            raise UsageError(f"line {number}: {where}: {' '.join(first['msg'].split())}") from None
        except UsageError as error:
            raise UsageError(f"line {number}: {error}") from None
        expected += 1
        yield line


def _check(line: PacketLine, expected: int, model: Model) -> None:
    if line.k != expected:
        raise UsageError(f"k: got {line.k}; allowed: {expected}, the steps in order without gaps")
    if len(line.u or ()) != model.q and not (line.u is None and model.q == 0):
        raise UsageError(f"u: got {len(line.u or ())} numbers; allowed: {model.q}")
    if line.y is not None and len(line.y) != model.p:
        raise UsageError(f"y: got {len(line.y)} numbers; allowed: {model.p}, or null")
    if line.gamma == 1 and line.y is None:
        raise UsageError("gamma: got 1 without y; allowed: 0 or left out where nothing arrived")
    for j, _ in line.acks or ():
        if j >= line.k:
            raise UsageError(f"acks: got control packet {j} at step {line.k}; allowed: 0 … {line.k - 1}")
    for j, y in line.late or ():
        if j >= line.k:
            raise UsageError(f"late: got the observation of step {j} at step {line.k}; allowed: 1 … {line.k - 1}")
        if len(y) != model.p:
            raise UsageError(f"late: got {len(y)} numbers; allowed: {model.p}")


def replay(
    estimator: Estimator | Refilter,
    model: Model,
    packets: Iterable[PacketLine],
    *,
    use_acks: bool,
    until: int | None = None,
) -> Iterator[str]:
    """Lines of OUT.jsonl: k, x_hat, P, up to step ``until``. Late observations are for a Refilter.

    An estimator with ``takes_noise`` gets a y that carried only noise as one that arrived.
    Raises what the estimator raises, and RunFailed for what is not finite.
    """
    buffered = estimator if isinstance(estimator, Refilter) else Refilter(estimator, 0)
    for line in packets:
        if until is not None and line.k > until:
            return
        received = np.array([line.y is not None])
        arrived = seen(buffered.estimator, received & (line.gamma != 0), received)
        y = line.y if line.y is not None else [0.0] * model.p
        acks = tuple(Ack(j, np.array([nu]), np.array([1])) for j, nu in line.acks or ()) if use_acks else ()
        late = [LateObservation(j, np.array([y]), np.array([True])) for j, y in line.late or ()]
        try:
            with np.errstate(over="ignore", invalid="ignore", divide="ignore"):
                estimate = buffered.step(np.array([line.u or []]), np.array([y]), arrived, acks, late)
                x_hat, P = estimate.x_hat[0], estimate.P[0]
        except TestbedError as error:
            raise type(error)(f"step {line.k}: {error}") from None
        if not (np.isfinite(x_hat).all() and np.isfinite(P).all()):
            raise RunFailed(f"step {line.k}: the estimate left the range of floating-point numbers")
        out: dict[str, Any] = {"k": line.k, "x_hat": x_hat.tolist(), "P": P.tolist()}
        if estimate.error_bound is not None and estimate.error_bound_P is not None:
            out["error_bound"] = float(estimate.error_bound[0])
            out["error_bound_P"] = float(estimate.error_bound_P[0])
        yield json.dumps(out)
