"""The plant of one block of lanes: x_{k+1} = A x_k + ν_k B u_k + G w_k, y_k = C x_k + v_k."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from testbed.numerics.lanes import (
    Constant,
    Floats,
    Mask,
    Vector,
    add,
    array_of,
    constant,
    constant_times,
    vector_of,
    where,
)
from testbed.numerics.streams import Stream
from testbed.scenario import Scenario


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
        g = np.eye(system.n) if system.G is None else np.array(system.G)
        self._lanes = lanes
        self._a, self._c = constant(system.A), constant(system.C)
        self._b: Constant | None = None if system.B is None else constant(system.B)
        self._process_root = constant(g @ root(np.array(system.Q)))
        self._sensor_root = constant(root(np.array(system.R)))

        def stream(purpose: str, width: int) -> Stream:
            return Stream(scenario.seed, "plant", purpose, width=width, lane=lane, lanes=lanes)

        self._process, self._sensor = stream("process", system.g), stream("sensor", system.p)
        spread = constant_times(constant(root(np.array(system.P0))), stream("initial", system.n).normals(0))
        self.x: Vector = [m + s for m, s in zip(system.x0_mean, spread, strict=True)]
        self._k = 0

    def move(self, u: Floats | None, applied: Mask) -> tuple[Floats, Floats]:
        """One step: apply u (M, q) where ``applied``, zero elsewhere. Returns x_{k+1} (M, n) and y_{k+1} (M, p)."""
        x = constant_times(self._a, self.x)
        if self._b is not None and u is not None:
            x = [a + where(applied, b, 0.0) for a, b in zip(x, constant_times(self._b, vector_of(u)), strict=True)]
        self.x = add(x, constant_times(self._process_root, self._process.normals(self._k)))
        self._k += 1
        noise = constant_times(self._sensor_root, self._sensor.normals(self._k))
        y = add(constant_times(self._c, self.x), noise)
        return array_of(self.x, self._lanes), array_of(y, self._lanes)


def bits(mask: Mask) -> NDArray[np.uint8]:
    """A mask as bytes 0 and 1 of shape (M,)."""
    if isinstance(mask, bool):
        return _ONE if mask else _ZERO
    return np.asarray(mask, dtype=np.uint8)


_ONE, _ZERO = np.ones(1, dtype=np.uint8), np.zeros(1, dtype=np.uint8)
