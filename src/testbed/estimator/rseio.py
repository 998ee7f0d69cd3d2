"""RSEIO: the robust state estimator with intermittent observations under model error (theory.md 3.7)."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache, partial
from typing import Annotated, ClassVar

import numpy as np
from annotated_types import Gt, Le

from testbed.estimator.kfio import Kfio
from testbed.estimator.model import Model
from testbed.estimator.riccati import Gain, phi, predict
from testbed.numerics.lanes import (
    Component,
    Constant,
    Floats,
    Mask,
    Matrix,
    Vector,
    add,
    any_of,
    constant,
    constant_sandwich,
    constant_times,
    scale,
    where_symmetric,
    where_vector,
)
from testbed.numerics.stepping import Step, masked_step
from testbed.numerics.symbols import Shape


class Rseio(Kfio):
    """Weighs the fit to model and data (mu) against how much the fit depends on the unknown parameters (1 − mu).

    mu = 1 is KFIO. P is the paper's pseudo-covariance, which is not the covariance of the error. The paper has no
    control; here ν must be known, as for KFIO, and ν B u is added to A x in the function that is minimised.
    """

    KIND: ClassVar[str] = "rseio"

    def __init__(self, model: Model, lanes: int, mu: Annotated[float, Gt(0), Le(1)] = 0.8) -> None:
        self.mu = mu
        super().__init__(model, lanes)

    @property
    def weight(self) -> float:
        """λ = (1 − μ)/μ."""
        return (1.0 - self.mu) / self.mu

    def _stepper(self) -> Step:
        return _stepper(self._model, self.weight, self._lanes)


@dataclass(frozen=True)
class _Sensitivity:
    """√λ [S T], −√λ col_k[0; dC_k], and what they act on: the entry [A G] of (x, w), and the covariance W of w."""

    by_state_and_noise: Constant
    by_push: Constant
    identity: Constant
    entry: Constant
    noise: Constant


def innovation_derivatives(model: Model) -> tuple[Floats, Floats]:
    """[S T] (2 p m, n + g) for m parameters, and −col_k[0; dC_k] (2 p m, n): theory.md 3.7; at most no rows."""
    n, p = model.n, model.p
    g = np.eye(n) if model.G is None else model.G
    rows: list[Floats] = [np.zeros((0, n + g.shape[1]))]
    pushes: list[Floats] = [np.zeros((0, n))]
    for k in range(max(len(model.dA), len(model.dG), len(model.dC))):
        d_a = model.dA[k] if model.dA else np.zeros((n, n))
        d_g = model.dG[k] if model.dG else np.zeros(g.shape)
        d_c = model.dC[k] if model.dC else np.zeros((p, n))
        rows += [np.hstack([model.C @ d_a, model.C @ d_g]), np.hstack([d_c @ model.A, d_c @ g])]
        pushes += [np.zeros((p, n)), d_c]
    return np.vstack(rows), -np.vstack(pushes)


def _sensitivity(model: Model, weight: float) -> _Sensitivity | None:
    """The derivatives of the innovation by each parameter, without rows of zeros; None where nothing is left."""
    g = np.eye(model.n) if model.G is None else model.G
    noise = model.Q if model.W is None else model.W
    rows, pushes = innovation_derivatives(model)
    h, s = np.sqrt(weight) * rows, np.sqrt(weight) * pushes
    kept = h.any(axis=1) | s.any(axis=1)
    if not kept.any():
        return None
    return _Sensitivity(
        constant(h[kept]),
        constant(s[kept]),
        constant(np.eye(int(kept.sum()))),
        constant(np.hstack([model.A, g])),
        constant(noise),
    )


def _advance(
    model: Model,
    sensitivity: _Sensitivity | None,
    gamma: Mask,
    x: Vector,
    P: Matrix,
    push: Vector,
    nu: Component,
    y: Vector,
) -> tuple[Vector, Matrix]:
    """One step from x̂ and P, with push = B u and known ν.

    γ = 0: the prediction of KFIO. γ = 1: the prediction [A G](x, w) from (x, w) as ``_desensitised`` finds it, which
    has the mean Â x̂ and the covariance A P̂ A' + Ĝ Q̂ Ĝ' of theory.md 3.7, then KFIO's update.
    """
    pushed = scale(nu, push)
    plain_mean, plain = constant_times(model.a, x), predict(model.a, P, model.noise)
    plain_mean = add(plain_mean, pushed) if model.q else plain_mean
    if not any_of(gamma):
        return plain_mean, plain
    mean, covariance = plain_mean, plain
    if sensitivity is not None:
        both, joint = _desensitised(sensitivity, x, P, pushed)
        mean = constant_times(sensitivity.entry, both)
        mean = add(mean, pushed) if model.q else mean
        covariance = constant_sandwich(sensitivity.entry, joint, _zeros(model.n))
    gain = Gain(covariance, model.c, model.sensor_noise)
    updated = where_vector(gamma, gain.correct(mean, y), plain_mean)
    if sensitivity is None:
        return updated, phi(covariance, gain, gamma)
    return updated, where_symmetric(gamma, gain.updated, plain)


@lru_cache(maxsize=16)
def _stepper(model: Model, weight: float, lanes: int) -> Step:
    state: tuple[Shape, ...] = (("vector", model.n), ("symmetric", model.n))
    given: tuple[Shape, ...] = (("vector", model.n), ("scalar", 1), ("vector", model.p))
    return masked_step(partial(_advance, model, _sensitivity(model, weight)), (*state, *given), state, lanes)


def _desensitised(sensitivity: _Sensitivity, x: Vector, P: Matrix, push: Vector) -> tuple[Vector, Matrix]:
    """The minimiser (x, w) of ‖x − x̂‖²_{P⁻¹} + ‖w‖²_{W⁻¹} + λ‖S x + T w + s‖², and the inverse of its Hessian.

    That is the update of the prior (x̂, 0), diag(P, W) by the observation 0 = √λ(S x + T w + s) + noise of covariance I;
    it needs no inverse of P or W, which may be singular. s: the part of νBu, which comes through C(ε).
    """
    n, noise = len(x), sensitivity.noise
    g = len(noise)
    prior: Matrix = [[*P[i], *[0.0] * g] for i in range(n)] + [[*[0.0] * n, *noise[i]] for i in range(g)]
    gain = Gain(prior, sensitivity.by_state_and_noise, sensitivity.identity)
    return gain.correct([*x, *[0.0] * g], constant_times(sensitivity.by_push, push)), gain.updated


def _zeros(n: int) -> Constant:
    return ((0.0,) * n,) * n
