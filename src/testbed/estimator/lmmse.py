"""LMMSE: the best linear filter for unacknowledged i.i.d. control losses (theory.md 3.8)."""

from __future__ import annotations

from functools import lru_cache, partial
from typing import Any, ClassVar

from numpy.typing import NDArray

from testbed.errors import UsageError
from testbed.estimator.model import Ack, Estimate, Model, expected_nu
from testbed.estimator.riccati import Gain, phi, predict_with_mean_control
from testbed.estimator.state import OneGaussian
from testbed.numerics.lanes import (
    Component,
    Floats,
    Mask,
    Matrix,
    Vector,
    any_of,
    mask_of,
    vector_of,
    where_vector,
)
from testbed.numerics.stepping import Step, masked_step
from testbed.numerics.symbols import Shape


class Lmmse(OneGaussian):
    """Linear: the control enters with its mean, its variance counts as noise, the gain is that of the whole P.

    An ACK of ν_{k−1} in time replaces the mean ν̄ of that packet by ν itself, so that with every ACK it is KFIO.
    """

    STATE_VERSION: ClassVar[int] = 1

    def __init__(self, model: Model, lanes: int) -> None:
        if not model.control.independent:
            raise UsageError(
                "estimator 'lmmse' holds for i.i.d. control losses only; for others use 'aoe', 'gpb', 'imm' or 'oe'"
            )
        self._model, self._lanes = model, lanes
        self._advance = _stepper(model, lanes)
        self._x, self._p = model.prior(lanes)
        self._k = 0
        self.counters: dict[str, int] = {}

    def step(self, u: Floats, y: Floats, arrived: NDArray[Any], acks: tuple[Ack, ...] = ()) -> Estimate:
        """Older ACKs than that of ν_{k−1} cannot be used and are counted."""
        gamma = mask_of(arrived)
        self._k += 1
        self._x, self._p = self._advance(
            gamma,
            self._x,
            self._p,
            expected_nu(self._model, acks, self._k - 1, self.counters),
            vector_of(u),
            vector_of(y),
        )
        return Estimate(self._x, self._p, self._lanes)


def _advance(
    model: Model, gamma: Mask, x: Vector, P: Matrix, rate: Component, u: Vector, y: Vector
) -> tuple[Vector, Matrix]:
    """One step from x̂ and P, with P(ν = 1) = rate."""
    mean, covariance = predict_with_mean_control(model, x, P, rate, u)
    gain = Gain(covariance, model.c, model.sensor_noise)
    updated = where_vector(gamma, gain.correct(mean, y), mean) if any_of(gamma) else mean
    return updated, phi(covariance, gain, gamma)


@lru_cache(maxsize=16)
def _stepper(model: Model, lanes: int) -> Step:
    state: tuple[Shape, ...] = (("vector", model.n), ("symmetric", model.n))
    given: tuple[Shape, ...] = (("scalar", 1), ("vector", model.q), ("vector", model.p))
    return masked_step(partial(_advance, model), (*state, *given), state, lanes)
