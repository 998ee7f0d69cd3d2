"""The plant of one block of lanes: x_{k+1} = A x_k + ν_k B u_k + G w_k, y_k = C x_k + v_k."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache, partial

import numpy as np
from numpy.typing import NDArray

from testbed.numerics.lanes import (
    Constant,
    Floats,
    Mask,
    Vector,
    add,
    any_of,
    array_of,
    constant,
    constant_times,
    vector_of,
    where,
)
from testbed.numerics.stepping import Step, masked_step
from testbed.numerics.streams import Stream
from testbed.numerics.symbols import Shape
from testbed.scenario import Scenario, System


def root(covariance: Floats) -> Floats:
    """L with L L' = covariance, for a positive semi-definite matrix: triangular if it is definite."""
    try:
        return np.asarray(np.linalg.cholesky(covariance))
    except np.linalg.LinAlgError:
        values, vectors = np.linalg.eigh(covariance)
        return np.asarray(vectors * np.sqrt(np.maximum(values, 0.0)))


class Plant:
    """Its noises depend on (seed, lane, step) only, so that every run and every split of the lanes sees the same."""

    def __init__(self, scenario: Scenario, lane: int, lanes: int) -> None:
        system = scenario.system
        self._lanes, self._matrices = lanes, _matrices(scenario.system)
        self._advance = _stepper(self._matrices, lanes)

        def stream(purpose: str, width: int) -> Stream:
            return Stream(scenario.seed, "plant", purpose, width=width, lane=lane, lanes=lanes)

        self._process, self._sensor = stream("process", system.g), stream("sensor", system.p)
        spread = constant_times(constant(root(np.array(system.P0))), stream("initial", system.n).normals(0))
        self.x: Vector = [m + s for m, s in zip(system.x0_mean, spread, strict=True)]
        self._k = 0

    def move(self, u: Floats | None, applied: Mask) -> tuple[Floats, Floats]:
        """One step: apply u (M, q) where ``applied``, zero elsewhere. Returns x_{k+1} (M, n) and y_{k+1} (M, p)."""
        control = [0.0] * self._matrices.q if u is None else vector_of(u)
        w, v = self._process.normals(self._k), self._sensor.normals(self._k + 1)
        self.x, y = self._advance(applied, self.x, control, w, v)
        self._k += 1
        return array_of(self.x, self._lanes), array_of(y, self._lanes)


@dataclass(frozen=True)
class _Matrices:
    """The plant's matrices; the noises enter through square roots of their covariances."""

    a: Constant
    b: Constant | None
    c: Constant
    process: Constant
    sensor: Constant
    q: int


@lru_cache(maxsize=16)
def _matrices(system: System) -> _Matrices:
    g = np.eye(system.n) if system.G is None else np.array(system.G)
    process, sensor = constant(g @ root(np.array(system.Q))), constant(root(np.array(system.R)))
    b = None if system.B is None else constant(system.B)
    return _Matrices(constant(system.A), b, constant(system.C), process, sensor, system.q)


def _advance(m: _Matrices, applied: Mask, x: Vector, u: Vector, w: Vector, v: Vector) -> tuple[Vector, Vector]:
    moved = constant_times(m.a, x)
    if m.b is not None and any_of(applied):
        push = [where(applied, b, 0.0) for b in constant_times(m.b, u)]
        moved = add(moved, push)
    x = add(moved, constant_times(m.process, w))
    return x, add(constant_times(m.c, x), constant_times(m.sensor, v))


@lru_cache(maxsize=16)
def _stepper(m: _Matrices, lanes: int) -> Step:
    n, p = len(m.a), len(m.c)
    arguments: tuple[Shape, ...] = (("vector", n), ("vector", m.q), ("vector", len(m.process[0])), ("vector", p))
    results: tuple[Shape, ...] = (("vector", n), ("vector", p))
    return masked_step(partial(_advance, m), arguments, results, lanes)


def bits(mask: Mask) -> NDArray[np.uint8]:
    """A mask as bytes 0 and 1 of shape (M,)."""
    if isinstance(mask, bool):
        return _ONE if mask else _ZERO
    return np.asarray(mask, dtype=np.uint8)


_ONE, _ZERO = np.ones(1, dtype=np.uint8), np.zeros(1, dtype=np.uint8)
