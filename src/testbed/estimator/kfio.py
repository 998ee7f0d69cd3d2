"""KFIO: the Kalman filter with intermittent observations and known control losses (theory.md 3.1)."""

from __future__ import annotations

from functools import lru_cache, partial
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from testbed.errors import UsageError
from testbed.estimator.errors import MissingAck
from testbed.estimator.hold import refuse_moments
from testbed.estimator.model import Ack, Estimate, Model, newest_ack
from testbed.estimator.riccati import Gain, phi, predict
from testbed.estimator.state import Given, OneGaussian, State, state_of
from testbed.numerics.lanes import (
    Component,
    Floats,
    Mask,
    Matrix,
    Vector,
    add,
    all_of,
    any_of,
    constant_times,
    full_vector,
    mask_of,
    scale,
    subtract,
    vector_of,
    where_vector,
)
from testbed.numerics.stepping import Step, masked_step
from testbed.numerics.symbols import Shape
from testbed.scenario import ConstantInput, Input, NoLoss, Scenario


class Kfio(OneGaussian):
    """Optimal when every ν_{k−1} is known at step k.

    ν need not be acknowledged where the control link never loses or where B u = 0; with an actuator that holds, where
    B u is what is applied already. There the state has the input applied last, ``applied`` (M, q).
    """

    KIND: ClassVar[str] = "kfio"
    STATE_VERSION: ClassVar[int] = 1
    takes_hold: ClassVar[bool] = True

    def __init__(self, model: Model, lanes: int) -> None:
        self._model, self._lanes = model, lanes
        self._advance = self._stepper()
        self._x, self._p = model.prior(lanes)
        self._applied = full_vector(np.zeros(model.q), lanes) if model.holds else None
        self._k = 0
        self.counters: dict[str, int] = {}

    def _stepper(self) -> Step:
        """What makes a step of (γ, x̂, P, B u, ν, y)."""
        return _stepper(self._model, self._lanes)

    def check_scenario(self, scenario: Scenario, acks: str, until: int) -> None:
        """Raises UsageError where the scenario cannot give it every ν it needs."""
        link = scenario.links.ack
        complete = acks == "perfect" or (acks == "link" and isinstance(link.loss, NoLoss))
        if not complete and not self._model.control.never_loses and self._model.q and not _zero(scenario.input):
            raise UsageError(
                f"{self.KIND} needs every ACK and gets {'none' if acks == 'none' else 'them over a lossy link'}; "
                'allowed: acks = "perfect" here, [links.ack] mode = "perfect", or another estimator (aoe, ff, oe)'
            )

    def step(self, u: Floats, y: Floats, arrived: NDArray[Any], acks: tuple[Ack, ...] = ()) -> Estimate:
        """Raises MissingAck where ν_{k−1} matters and is not known."""
        model, gamma = self._model, mask_of(arrived)
        nu: Component
        if self._applied is None:
            push = model.control_effect(vector_of(u)) if model.q else [0.0] * model.n
            nu = self._nu(push, acks)
        else:
            push, nu = self._held(vector_of(u), self._applied, acks), 1.0
        self._k += 1
        self._x, self._p = self._advance(gamma, self._x, self._p, push, nu, vector_of(y))
        return Estimate(self._x, self._p, self._lanes)

    def state(self) -> State:
        held = {} if self._applied is None else state_of(self._k, self._lanes, {"applied": self._applied})
        return super().state() | held

    def set_state(self, state: State) -> None:
        if self._applied is None:
            return super().set_state(state)
        given = Given(state, self._lanes, self._model.n)
        x, p, applied = given.vector("x"), given.matrix("P"), given.vector("applied", self._model.q)
        given.end()
        self._k, self._x, self._p, self._applied = given.step, x, p, applied
        return None

    def start_from(self, step: int, x_hat: Floats, P: Floats) -> None:
        refuse_moments(self._model, step)
        super().start_from(step, x_hat, P)
        if self._applied is not None:
            self._applied = full_vector(np.zeros(self._model.q), self._lanes)

    def _held(self, u: Vector, applied: Vector, acks: tuple[Ack, ...]) -> Vector:
        """B a_{k−1}, with a_{k−1} = u where that packet arrived and what was ``applied`` before where not."""
        arrived = self._nu(self._model.control_effect(subtract(u, applied)), acks) == 1.0
        self._applied = where_vector(arrived, u, applied)
        return self._model.control_effect(self._applied)

    def _nu(self, push: Vector, acks: tuple[Ack, ...]) -> Component:
        ack = newest_ack(acks, self._k, self.counters)
        if self._model.control.never_loses:
            return 1.0
        known, nu = ack if ack is not None else (False, 0.0)
        if all_of(known):
            return nu
        idle = np.all([np.asarray(b) == 0.0 for b in push], axis=0) if push else np.True_
        if not np.all(known | idle):
            raise MissingAck(
                f"{self.KIND} needs the ACK of control packet {self._k} at step {self._k + 1} and none has come; "
                'give it acks = "perfect", or use aoe, ff or oe'
            )
        return nu


def advance(
    model: Model, gamma: Mask, x: Vector, P: Matrix, push: Vector, nu: Component, y: Vector
) -> tuple[Vector, Matrix]:
    """One step from x̂ and P, with push = B u and known ν."""
    mean = add(constant_times(model.a, x), scale(nu, push)) if model.q else constant_times(model.a, x)
    covariance = predict(model.a, P, model.noise)
    gain = Gain(covariance, model.c, model.sensor_noise)
    updated = where_vector(gamma, gain.correct(mean, y), mean) if any_of(gamma) else mean
    return updated, phi(covariance, gain, gamma)


@lru_cache(maxsize=16)
def _stepper(model: Model, lanes: int) -> Step:
    state: tuple[Shape, ...] = (("vector", model.n), ("symmetric", model.n))
    given: tuple[Shape, ...] = (("vector", model.n), ("scalar", 1), ("vector", model.p))
    return masked_step(partial(advance, model), (*state, *given), state, lanes)


def _zero(source: Input | None) -> bool:
    return source is None or (isinstance(source, ConstantInput) and not any(source.value))
