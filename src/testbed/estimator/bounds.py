"""The bounds Pᴬ_k ≤ E_Y[P_k] ≤ S_k of M Theorem 3 (theory.md 3.6), on the losses of each lane.

S adds ¼U a step, the largest variance that an unknown ν_k can bring. That accounts for i.i.d. control losses. Under
Markov losses the ν_k are correlated and their contributions can add up to more: with A = B = C = 1, u = 2, Q = ½,
P_0 = 0, a chain that never moves from its start ½ and no observation, P_2 = 5 while S_2 = 3. Since
Cov(ν_i, ν_j) ≤ ¼ |r|^|i−j| with r = 1 − recovery − failure, and by Gershgorin's theorem, ¼U (1 + |r|)/(1 − |r|) a step
is enough for the best estimator; that is the *correlated* upper bound here. For Gilbert–Elliott losses Cov(ν_i, ν_j) =
δ² r^|i−j| Var(s_i), i < j, with s_i = 1 in the good state, r the memory of the states, and δ the difference of their
arrival probabilities: ¼U (1 + 2 δ² |r|/(1 − |r|)) is enough. In general the factor of ¼U is the ``covariance_factor``
of the losses.


With an actuator that holds, what is not known is the applied input a_k, and ¼U is a bound of Var(B a_k). Under i.i.d.
losses with arrival rate λ, E[a_j | a_i] − E[a_j] = (1 − λ)^(j−i) (a_i − E[a_i]) for i < j, so that Cov(a_i, a_j) =
(1 − λ)^|i−j| Var(a_min(i,j)). As |v'Dw| ≤ ½ v'Dv + ½ w'Dw for each D = Var(a_i), white noise of the covariance
¼U Σ_m (1 − λ)^|m| = ¼U (2 − λ)/λ a step is not below the joint covariance of the B a_k. It is enough for a linear
filter, and so in the mean for the best estimator. For other losses, where how long an input is held depends on when it
came, no bound is given.
"""

from __future__ import annotations

from collections.abc import Iterable
from functools import lru_cache, partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from testbed.channel.law import LossModel
from testbed.estimator.model import Model
from testbed.estimator.riccati import Gain, phi, predict
from testbed.numerics.lanes import Constant, Floats, Mask, Matrix, constant, mask_of, matrices_of, matrix_of
from testbed.numerics.packed import Named
from testbed.numerics.stepping import Step, masked_step
from testbed.numerics.symbols import Shape


def held_factor(control: LossModel) -> float | None:
    """(2 − λ)/λ, by which the holding of inputs adds up; None where no bound is known."""
    if not control.independent or control.first_arrival == 0.0:
        return None
    return (2.0 - control.first_arrival) / control.first_arrival


class CovarianceBound:
    """P_{k+1} = φ(A P_k A' + noise, γ_{k+1}) from P_0 in every lane: Pᴬ with noise Q, S with Q + ¼U."""

    def __init__(self, model: Model, noise: Floats, lanes: int) -> None:
        _, self.p = model.prior(lanes)
        self._advance = _stepper(model, constant(noise), lanes)
        self.lanes, self._n = lanes, model.n

    @property
    def state(self) -> Floats:
        """The bound as it is now, (M, n, n): all that the next one depends on."""
        return matrices_of(self.p, self.lanes)

    def resume(self, given: Named, name: str) -> None:
        """Go on from what ``state`` was. Raises UsageError where ``given`` does not have that under ``name``."""
        self.p = matrix_of(given.array(name, np.float64, self.lanes, self._n, self._n))

    def step(self, arrived: NDArray[Any]) -> Matrix:
        """The bound after the observations ``arrived`` (M,) of the next step."""
        (self.p,) = self._advance(mask_of(arrived), self.p)
        return self.p


def upper_bound(model: Model, U: Floats, lanes: int) -> CovarianceBound:
    """S for an input with Var(ν_k B u_k) ≤ ¼U for all k, so with B u_k u_k' B' ≤ U."""
    return CovarianceBound(model, model.Q + 0.25 * U, lanes)


class LateBound:
    """Pᴬ_k given all observations of steps 1 … k that have arrived by k, late ones too.

    Steps are remembered for ``depth``. What comes later than that counts as not arrived, and ``old`` counts it.
    """

    def __init__(self, model: Model, lanes: int, depth: int) -> None:
        self._bound = CovarianceBound(model, model.Q, lanes)
        self._depth, self._k, self.old = depth, 0, 0
        self._states: dict[int, tuple[Matrix, NDArray[Any]]] = {}
        """By step: what was known before it, and where its observation has arrived."""

    def state(self) -> dict[str, NDArray[Any]]:
        """The bound before the first step that is remembered, and what has arrived of it and later ones."""
        if not self._states:
            return {}
        first = min(self._states)
        known = [self._states[step][1] for step in range(first, self._k + 1)]
        return {
            "before": matrices_of(self._states[first][0], self._bound.lanes),
            "known": np.array(known, dtype=np.uint8),
        }

    def resume(self, step: int, given: Named, old: int) -> None:
        """Go on after ``step`` steps, from what ``state`` gave, by at most ``depth`` steps; ``old``: the count."""
        self._k, self.old = step, old
        if not step:
            return
        self._bound.resume(given, "before")
        known = given.array("known", np.uint8, min(step, self._depth), self._bound.lanes)
        for number, arrived in enumerate(known, start=step - len(known) + 1):
            self._take(number, arrived)

    def step(self, arrived: NDArray[Any], late: Iterable[tuple[int, NDArray[Any]]] = ()) -> Matrix:
        """The bound after the next step's observations ``arrived`` (M,), and ``late`` ones: (step, lanes (M,))."""
        again = self._k + 1
        for step, lanes in late:
            if step in self._states:
                before, known = self._states[step]
                self._states[step] = before, np.asarray(known, dtype=np.bool_) | np.asarray(lanes, dtype=np.bool_)
                again = min(again, step)
            else:
                self.old += int(np.count_nonzero(lanes))
        if again <= self._k:
            self._bound.p = self._states[again][0]
            for step in range(again, self._k + 1):
                self._take(step, self._states[step][1])
        self._k += 1
        self._states.pop(self._k - self._depth, None)
        return self._take(self._k, arrived)

    def _take(self, step: int, arrived: NDArray[Any]) -> Matrix:
        self._states[step] = self._bound.p, arrived
        return self._bound.step(np.asarray(arrived, dtype=np.uint8))


class Bounds:
    """Lower: the ACK covariance Pᴬ. Upper: S, for an input with B u_k u_k' B' ≤ U for all k; none without U.

    With an actuator that holds: Var(B a_k) ≤ ¼U for all k; none where losses are not i.i.d.
    """

    def __init__(self, model: Model, U: Floats | None, lanes: int) -> None:
        self._lanes = lanes
        self._lower = CovarianceBound(model, model.Q, lanes)
        factor = held_factor(model.control) if model.holds else 1.0
        self._upper = None if U is None or factor is None else upper_bound(model, factor * U, lanes)

    def step(self, arrived: NDArray[Any]) -> tuple[Floats, Floats | None]:
        """Pᴬ_k and S_k, each (M, n, n), after the observations ``arrived`` (M,) of step k."""
        lower, upper = self.components(arrived)
        return matrices_of(lower, self._lanes), None if upper is None else matrices_of(upper, self._lanes)

    def components(self, arrived: NDArray[Any]) -> tuple[Matrix, Matrix | None]:
        """The same as components."""
        return self._lower.step(arrived), None if self._upper is None else self._upper.step(arrived)

    def state(self) -> dict[str, Floats]:
        """Both bounds as they are now, (M, n, n)."""
        return {"lower": self._lower.state, **({} if self._upper is None else {"upper": self._upper.state})}

    def resume(self, given: Named) -> None:
        """Go on from what ``state`` gave. Raises UsageError for anything else."""
        self._lower.resume(given, "lower")
        if self._upper is not None:
            self._upper.resume(given, "upper")


def _advance(model: Model, noise: Constant, gamma: Mask, P: Matrix) -> tuple[Matrix]:
    """One step of a covariance: φ(A P A' + noise, γ)."""
    covariance = predict(model.a, P, noise)
    return (phi(covariance, Gain(covariance, model.c, model.sensor_noise), gamma),)


@lru_cache(maxsize=16)
def _stepper(model: Model, noise: Constant, lanes: int) -> Step:
    shape: tuple[Shape, ...] = (("symmetric", model.n),)
    return masked_step(partial(_advance, model, noise), shape, shape, lanes)
