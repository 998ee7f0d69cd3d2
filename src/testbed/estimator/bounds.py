"""The bounds Pᴬ_k ≤ E_Y[P_k] ≤ S_k of M Theorem 3 (theory.md 3.6), on the losses of each lane.

S adds ¼U a step, the largest variance that an unknown ν_k can bring. That accounts for i.i.d. control losses. Under
Markov losses the ν_k are correlated and their contributions can add up to more: with A = B = C = 1, u = 2, Q = ½,
P_0 = 0, a chain that never moves from its start ½ and no observation, P_2 = 5 while S_2 = 3. Since
Cov(ν_i, ν_j) ≤ ¼ |r|^|i−j| with r = 1 − recovery − failure, and by Gershgorin's theorem, ¼U (1 + |r|)/(1 − |r|) a step
is enough for the best estimator; that is the *correlated* upper bound here.
"""

from __future__ import annotations

from functools import lru_cache, partial
from typing import Any

from numpy.typing import NDArray

from testbed.channel.loss import Chain
from testbed.estimator.model import Model
from testbed.estimator.riccati import Gain, phi, predict
from testbed.numerics.lanes import Constant, Floats, Mask, Matrix, constant, mask_of, matrices_of
from testbed.numerics.stepping import Step, masked_step
from testbed.numerics.symbols import Shape


def correlation_factor(control: Chain) -> float | None:
    """(1 + |r|)/(1 − |r|) of the control losses: 1 for i.i.d. ones, None where it is infinite."""
    r = 0.0 if control.independent or control.never_loses else abs(1.0 - control.recovery - control.failure)
    return (1.0 + r) / (1.0 - r) if r < 1.0 else None


class Bounds:
    """Lower: the ACK covariance Pᴬ. Upper: S, for an input with B u_k u_k' B' ≤ U for all k; none without U."""

    def __init__(self, model: Model, U: Floats | None, lanes: int) -> None:
        self._model, self._lanes = model, lanes
        _, self._lower = model.prior(lanes)
        self._upper: Matrix | None = self._lower if U is not None else None
        self._upper_noise = constant(model.Q if U is None else model.Q + 0.25 * U)

    def step(self, arrived: NDArray[Any]) -> tuple[Floats, Floats | None]:
        """Pᴬ_k and S_k, each (M, n, n), after the observations ``arrived`` (M,) of step k."""
        lower, upper = self.components(arrived)
        return matrices_of(lower, self._lanes), None if upper is None else matrices_of(upper, self._lanes)

    def components(self, arrived: NDArray[Any]) -> tuple[Matrix, Matrix | None]:
        model, gamma = self._model, mask_of(arrived)
        self._lower = self._next(self._lower, model.noise, gamma)
        if self._upper is not None:
            self._upper = self._next(self._upper, self._upper_noise, gamma)
        return self._lower, self._upper

    def _next(self, P: Matrix, noise: Constant, gamma: Mask) -> Matrix:
        (advanced,) = _stepper(self._model, noise, self._lanes)(gamma, P)
        return advanced  # type: ignore[no-any-return]


def _advance(model: Model, noise: Constant, gamma: Mask, P: Matrix) -> tuple[Matrix]:
    """One step of a covariance: φ(A P A' + noise, γ)."""
    covariance = predict(model.a, P, noise)
    return (phi(covariance, Gain(covariance, model.c, model.sensor_noise), gamma),)


@lru_cache(maxsize=16)
def _stepper(model: Model, noise: Constant, lanes: int) -> Step:
    shape: tuple[Shape, ...] = (("symmetric", model.n),)
    return masked_step(partial(_advance, model, noise), shape, shape, lanes)
