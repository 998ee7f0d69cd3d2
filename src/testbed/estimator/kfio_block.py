"""KFIO over a block of steps in one call, for recorded or simulated data: the numbers of ``Kfio``, lanes last."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache, partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from testbed.errors import UsageError
from testbed.estimator.errors import MissingAck
from testbed.estimator.kfio import advance
from testbed.estimator.model import Model
from testbed.numerics.lanes import Component, Floats, Mask, Matrix, Vector
from testbed.numerics.scans import LANE_STEPS_MIN, Scan, scan
from testbed.numerics.symbols import Shape


@dataclass(frozen=True)
class Block:
    """Estimates of T steps and M lanes, lanes last as they were computed."""

    x_hat: Floats
    """(T, n, M)"""
    P_upper: Floats
    """(T, n(n + 1)/2, M): the upper triangles by rows."""

    @classmethod
    def empty(cls, model: Model, steps: int, lanes: int) -> Block:
        """Room for the estimates of T steps and M lanes."""
        return cls(np.empty((steps, model.n, lanes)), np.empty((steps, model.n * (model.n + 1) // 2, lanes)))

    @property
    def P(self) -> Floats:
        """(T, n, n, M), a copy."""
        n = self.x_hat.shape[1]
        at = np.zeros((n, n), dtype=np.intp)
        rows, columns = np.triu_indices(n)
        at[rows, columns] = at[columns, rows] = np.arange(len(rows))
        return self.P_upper[:, at]


def filter_block(
    model: Model,
    y: NDArray[Any],
    arrived: NDArray[Any],
    u: NDArray[Any] | None = None,
    nu: NDArray[Any] | None = None,
    *,
    after: Block | None = None,
    out: Block | None = None,
) -> Block:
    """x̂ and P of KFIO (theory.md 3.1) after each of T steps, in M lanes, to the bits of ``Kfio.step``.

    y (T, p, M), with anything at all where nothing arrived, NaN too; arrived (T, M); u (T, q, M) and nu (T, M): u_{k−1}
    as sent and ν_{k−1}, for the step k of the same row. u may be missing where the model has no B; nu there too, and
    where control packets never get lost.

    after: the block of the T steps before, to go on from its last; None begins at x̄_0 and P_0.
    out: where the estimates are written, an earlier block of the same shape that is not needed any more. Fresh memory
    costs as much time as the filter does.

    The interpreter is free meanwhile: threads may filter blocks of different lanes side by side.

    Raises UsageError for a shape that does not fit, and with an actuator that holds; MissingAck where ν is needed and
    missing.
    """
    if model.holds:
        raise UsageError(
            'filter_block: got a model with on_loss = "hold"; allowed: one whose control link never loses, with the '
            "u that was applied (testbed.estimator.hold.applied_inputs)"
        )
    arrived = np.asarray(arrived)
    if arrived.ndim != 2:
        raise UsageError(f"arrived: got the shape {arrived.shape}; allowed: (steps, lanes)")
    steps, lanes = arrived.shape
    if not steps or not lanes:
        raise UsageError(f"arrived: got the shape {arrived.shape}; allowed: one step and one lane, or more")
    given = [_shaped("y", y, (steps, model.p, lanes))]
    if model.q:
        given.append(_shaped("u", u, (steps, model.q, lanes)))
        if not model.control.never_loses:
            if nu is None:
                raise MissingAck("filter_block needs nu where control packets get lost; aoe, ff and oe do without")
            given.append(_shaped("nu", nu, (steps, lanes)).reshape(steps, 1, lanes))
    before = _last(model, lanes, after)
    if out is None:
        out = Block.empty(model, steps, lanes)
    _check_room("x_hat", out.x_hat, (steps, *before[0].shape))
    _check_room("P_upper", out.P_upper, (steps, *before[1].shape))
    mask = np.ascontiguousarray(arrived, dtype=np.bool_)
    _scan(model, steps * lanes >= LANE_STEPS_MIN)(mask, before, given, (out.x_hat, out.P_upper))
    return out


def _shaped(name: str, array: NDArray[Any] | None, shape: tuple[int, ...]) -> Floats:
    if array is None:
        raise UsageError(f"{name}: got none; allowed: an array of shape {shape}")
    found = np.ascontiguousarray(array, dtype=np.float64)
    if found.shape != shape:
        raise UsageError(f"{name}: got the shape {found.shape}; allowed: {shape}, as arrived and the model say")
    return found


def _check_room(name: str, room: Floats, shape: tuple[int, ...]) -> None:
    if room.shape != shape or room.dtype != np.float64 or not room.flags.c_contiguous:
        raise UsageError(f"out.{name}: got {room.dtype} {room.shape}; allowed: contiguous float64 {shape}")


def _last(model: Model, lanes: int, block: Block | None) -> tuple[Floats, Floats]:
    """The state before the first step, copied: (n, M) and (n(n + 1)/2, M)."""
    if block is None:
        upper = model.P0[np.triu_indices(model.n)]
        return np.repeat(model.x0_mean[:, None], lanes, axis=1), np.repeat(upper[:, None], lanes, axis=1)
    wanted = (model.n, lanes)
    if block.x_hat.shape[1:] != wanted:
        raise UsageError(f"after: got states and lanes {block.x_hat.shape[1:]}; allowed: {wanted}")
    return block.x_hat[-1].copy(), block.P_upper[-1].copy()


def _step(
    model: Model, gamma: Mask, x: Vector, P: Matrix, y: Vector, u: Vector | None = None, nu: Component = 1.0
) -> tuple[Vector, Matrix]:
    push = model.control_effect(u) if u is not None else [0.0] * model.n
    return advance(model, gamma, x, P, push, nu, y)


@lru_cache(maxsize=16)
def _scan(model: Model, large: bool) -> Scan:
    state: tuple[Shape, ...] = (("vector", model.n), ("symmetric", model.n))
    given: list[Shape] = [("vector", model.p)]
    if model.q:
        given.append(("vector", model.q))
        if not model.control.never_loses:
            given.append(("scalar", 1))
    return scan(partial(_step, model), state, given, LANE_STEPS_MIN if large else 0)
