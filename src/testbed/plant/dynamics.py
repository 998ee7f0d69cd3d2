"""The plant of one block of lanes: x_{k+1} = A x_k + ν_k B u_k + G w_k, y_k = C x_k + v_k.

With model error A, G and C are A(ε_k), G(ε_k) and C(ε_k); ε_k is that of the step and the lane. An actuator that
holds applies B a_k in place of ν_k B u_k, with a_k = ν_k u_k + (1 − ν_k) a_{k−1} and a_{−1} = 0.
Where events let the plant drift, all of them are those of the step (`testbed.scenario.drift`).
"""

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
    full_vector,
    vector_of,
    where,
    where_vector,
)
from testbed.numerics.packed import Named
from testbed.numerics.stepping import Step, masked_step
from testbed.numerics.streams import Stream
from testbed.numerics.symbols import Shape
from testbed.scenario import Scenario, System, Uncertainty
from testbed.scenario.drift import moving, settles
from testbed.scenario.plant_events import PlantEvent


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
        self._lanes, self._matrices = lanes, _matrices(system)
        self._advance = _stepper(self._matrices, lanes)
        uncertainty = scenario.uncertainty
        self._nominal, self._uncertainty, self._moved_by = system, uncertainty, system
        self._derivatives, self._delta = _derivatives(system, uncertainty), 0.0

        def stream(purpose: str, width: int) -> Stream:
            return Stream(scenario.seed, "plant", purpose, width=width, lane=lane, lanes=lanes)

        self._process, self._sensor = stream("process", system.g), stream("sensor", system.p)
        spread = constant_times(constant(root(np.array(system.P0))), stream("initial", system.n).normals(0))
        self.x: Vector = [m + s for m, s in zip(system.x0_mean, spread, strict=True)]
        self._noise: Vector = []
        self._applied: Vector = full_vector(np.zeros(system.q), lanes)
        self._k = 0
        self._keeps_applied = scenario.cost is not None
        self._held = full_vector(np.zeros(system.q), lanes) if scenario.actuator.on_loss == "hold" else None
        self._everywhere: Mask = True if lanes == 1 else np.ones(lanes, dtype=np.bool_)
        if uncertainty is not None and self._derivatives is not None:
            self._delta = uncertainty.delta
            self._parameters = stream("uncertainty", uncertainty.parameters)
            self._epsilon = self._draw(0)
            self._advance_uncertain = _uncertain_stepper(self._matrices, self._derivatives, lanes)
        self._drift: list[tuple[int, PlantEvent]] = []
        self._compiled, self._settles = True, 0
        for step, event in scenario.drift:
            self.change(step, event)

    def change(self, step: int, event: PlantEvent) -> None:
        """Let parameters change from a step on that is still to come."""
        self._drift = sorted([*self._drift, (step, event)], key=lambda entry: entry[0])
        self._settles, self._compiled = settles(self._drift), False

    def _parameters_now(self) -> None:
        """Those of this move; straight-line code is made once they have come to rest."""
        system = moving(self._nominal, self._drift, self._k)
        if system == self._moved_by and self._compiled:
            return
        self._moved_by, self._compiled = system, self._k >= self._settles or system == self._nominal
        self._matrices = _matrices(system)
        if self._derivatives is None:
            made = _stepper(self._matrices, self._lanes) if self._compiled else partial(_advance, self._matrices)
            self._advance = made
            return
        self._derivatives = _derivatives(system, self._uncertainty)
        assert self._derivatives is not None
        if self._compiled:
            self._advance_uncertain = _uncertain_stepper(self._matrices, self._derivatives, self._lanes)
        else:
            self._advance_uncertain = partial(_advance_uncertain, self._matrices, self._derivatives)

    def _draw(self, k: int) -> Vector:
        """ε_k."""
        return [self._delta * (2.0 * uniform - 1.0) for uniform in self._parameters.uniforms(k)]

    @property
    def noise(self) -> Floats:
        """v_k (M, p) of the last observation."""
        return array_of(constant_times(self._matrices.sensor, self._noise), self._lanes)

    @property
    def applied(self) -> Floats:
        """The input (M, q) of the last step: u where it arrived, elsewhere zero or what was held."""
        return array_of(self._applied, self._lanes)

    def move(self, u: Floats | None, applied: Mask) -> tuple[Floats, Floats]:
        """One step: apply u (M, q) where ``applied``, elsewhere zero or what was applied last.

        Returns x_{k+1} (M, n) and y_{k+1} (M, p).
        """
        if self._drift and (self._k <= self._settles or not self._compiled):
            self._parameters_now()
        control = [0.0] * self._matrices.q if u is None else vector_of(u)
        if self._held is not None:
            self._held = control = where_vector(applied, control, self._held)
            applied = self._everywhere
        if self._keeps_applied:
            self._applied = [where(applied, c, 0.0) for c in control]
        w, v = self._process.normals(self._k), self._sensor.normals(self._k + 1)
        if self._derivatives is None:
            self.x, y = self._advance(applied, self.x, control, w, v)
        else:
            before, self._epsilon = self._epsilon, self._draw(self._k + 1)
            self.x, y = self._advance_uncertain(applied, self.x, control, w, v, before, self._epsilon)
        self._noise = v
        self._k += 1
        return array_of(self.x, self._lanes), array_of(y, self._lanes)

    def state(self) -> dict[str, Floats]:
        """All that the steps to come depend on, besides their number: x (M, n), and the input that is held (M, q)."""
        held = {} if self._held is None else {"held": array_of(self._held, self._lanes)}
        return {"x": array_of(self.x, self._lanes), **held}

    def resume(self, step: int, state: Named) -> None:
        """Go on after ``step`` steps from what ``state`` gave. Raises UsageError, and changes nothing, for another."""
        m = self._matrices
        x = vector_of(state.array("x", np.float64, self._lanes, len(m.a)))
        if self._held is not None:
            self._held = vector_of(state.array("held", np.float64, self._lanes, m.q))
        self._k, self.x = step, x
        if self._derivatives is not None:
            self._epsilon = self._draw(step)


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


@dataclass(frozen=True)
class _Derivatives:
    """By each parameter: of A, of the root through which the process noise enters, and of C."""

    a: tuple[Constant, ...]
    process: tuple[Constant, ...]
    c: tuple[Constant, ...]


@lru_cache(maxsize=16)
def _derivatives(system: System, uncertainty: Uncertainty | None) -> _Derivatives | None:
    """None where the plant is that of the model."""
    if uncertainty is None or uncertainty.delta == 0.0:
        return None
    noise = root(np.array(system.Q))
    return _Derivatives(
        tuple(constant(d) for d in uncertainty.dA),
        tuple(constant(np.array(d) @ noise) for d in uncertainty.dG),
        tuple(constant(d) for d in uncertainty.dC),
    )


def _shifted(base: Vector, epsilon: Vector, derivatives: tuple[Constant, ...], x: Vector) -> Vector:
    """base + Σ ε_k D_k x; no derivatives: base."""
    for e, derivative in zip(epsilon, derivatives, strict=False):
        moved = constant_times(derivative, x)
        base = [b + e * m if any(row) else b for b, m, row in zip(base, moved, derivative, strict=True)]
    return base


def _advance_uncertain(
    m: _Matrices,
    d: _Derivatives,
    applied: Mask,
    x: Vector,
    u: Vector,
    w: Vector,
    v: Vector,
    before: Vector,
    after: Vector,
) -> tuple[Vector, Vector]:
    """x_{k+1} by A(ε_k) and G(ε_k), y_{k+1} by C(ε_{k+1}); before: ε_k, after: ε_{k+1}."""
    moved = _shifted(constant_times(m.a, x), before, d.a, x)
    if m.b is not None and any_of(applied):
        push = [where(applied, b, 0.0) for b in constant_times(m.b, u)]
        moved = add(moved, push)
    x = add(moved, _shifted(constant_times(m.process, w), before, d.process, w))
    return x, add(_shifted(constant_times(m.c, x), after, d.c, x), constant_times(m.sensor, v))


@lru_cache(maxsize=16)
def _uncertain_stepper(m: _Matrices, d: _Derivatives, lanes: int) -> Step:
    n, p = len(m.a), len(m.c)
    parameters = max(len(d.a), len(d.process), len(d.c))
    noises: tuple[Shape, ...] = (("vector", len(m.process[0])), ("vector", p))
    drawn: tuple[Shape, ...] = (("vector", parameters), ("vector", parameters))
    results: tuple[Shape, ...] = (("vector", n), ("vector", p))
    arguments: tuple[Shape, ...] = (("vector", n), ("vector", m.q), *noises, *drawn)
    return masked_step(partial(_advance_uncertain, m, d), arguments, results, lanes)


def bits(mask: Mask) -> NDArray[np.uint8]:
    """A mask as bytes 0 and 1 of shape (M,)."""
    if isinstance(mask, bool):
        return _ONE if mask else _ZERO
    return np.asarray(mask, dtype=np.uint8)


_ONE, _ZERO = np.ones(1, dtype=np.uint8), np.zeros(1, dtype=np.uint8)
