"""GPB of order d: a Gaussian for each setting of the last d control bits, between AOE and OE (theory.md 3.5)."""

from __future__ import annotations

from collections.abc import Callable
from functools import lru_cache, partial
from typing import Annotated, Any, ClassVar

import numpy as np
from annotated_types import Ge, Le
from numpy.typing import NDArray

from testbed.estimator.fates import fates_of
from testbed.estimator.hold import kept, of_state, prior_of, refuse_moments, renewed, size_of, with_input
from testbed.estimator.mixtures import IMPOSSIBLE, Part, all_merged
from testbed.estimator.model import Ack, Estimate, Model
from testbed.estimator.riccati import Gain, log_odds, phi, predict
from testbed.estimator.state import Given, State, start_of
from testbed.numerics.kernels import LANES_MIN
from testbed.numerics.lanes import (
    Component,
    Floats,
    Mask,
    Matrix,
    Vector,
    add,
    any_of,
    constant_times,
    many_lanes,
    subtract,
    symmetric,
    where,
    where_vector,
)
from testbed.numerics.stepping import Step, masked_step
from testbed.numerics.symbols import Shape

MAX_ORDER = 12


class Gpb:
    """The last d control bits told apart, what lies before them merged by its moments.

    Order 0 keeps one Gaussian, as AOE does. A step splits each of the 2^d Gaussians in two by ν_{k−1}, observes with
    2^(d+1) of them, and then merges the pairs that differ in the oldest bit. So it is OE up to step d + 1.

    Components are arrays of shape (H · M,), the M lanes of hypothesis 0 first; the bits of a hypothesis' number are the
    fates of the last packets, the newest in the highest bit. With an actuator that holds, they are Gaussians of
    (x, a), a the input applied last (see ``hold``).
    """

    STATE_VERSION: ClassVar[int] = 1
    takes_hold: ClassVar[bool] = True

    def __init__(self, model: Model, lanes: int, order: Annotated[int, Ge(0), Le(MAX_ORDER)] = 2) -> None:
        self._model, self._lanes, self._order = model, lanes, order
        self._size = size_of(model)
        x, p = prior_of(model, lanes)
        self._x: Vector = [np.array(np.broadcast_to(v, lanes)) for v in x]
        self._p = symmetric(self._size, lambda i, j: np.array(np.broadcast_to(p[i][j], lanes)))
        self._score: Floats = np.zeros(lanes)
        self._bits = 0  # told apart
        self._fates = fates_of(model.law)
        self._k = 0
        self.counters: dict[str, int] = {}

    def step(self, u: Floats, y: Floats, arrived: NDArray[Any], acks: tuple[Ack, ...] = ()) -> Estimate:
        """ACKs of ν_{k−1} and of the d packets before are used; older ones come too late and are counted."""
        model = self._model
        self._k += 1
        for ack in acks:
            self._learn(ack)
        priors = self._priors(acks)
        size = len(self._score)
        if model.holds:
            control = _repeated(u, size)
        else:
            control = model.control_effect(_repeated(u, size)) if model.q else [np.zeros(size)] * model.n
        mask = np.tile(np.asarray(arrived, dtype=np.bool_), size // self._lanes)
        given: list[Any] = [self._x, self._p, control, _repeated(y, size)]
        if size == 1:
            given = [_mapped(_number, value) for value in given]
        gamma = bool(mask[0]) if size == 1 else mask
        out = (_held_stepper if model.holds else _stepper)(model, _kind(size))(gamma, *given)
        idle, moved, *covariances, lost, delivered = (_mapped(partial(_array, size=size), value) for value in out)
        gained = lost, delivered
        scores = [self._score + prior + plus for prior, plus in zip(priors, gained, strict=True)]
        self._x = [np.concatenate(pair) for pair in zip(idle, moved, strict=True)]
        first, second = covariances[0], covariances[-1]
        self._p = symmetric(self._size, lambda i, j: np.concatenate([first[i][j], second[i][j]]))
        self._score = np.concatenate(scores)
        self._bits += 1
        self._fates.branch()
        self._level()
        estimate = self._moments()
        if self._bits > self._order:
            self._forget()
        return estimate

    def state(self) -> State:
        """x (n, S), P (n, n, S), score (S,), S = 2^bits · M, and what is known of the fate of the next packet.

        n + q in place of n with an actuator that holds.
        """
        arrays = {"x": self._x, "P": self._p, "score": self._score, **self._fates.state()}
        numbers = {"k": self._k, "bits": self._bits}
        return {name: np.array(value, dtype=np.int64) for name, value in numbers.items()} | {
            name: np.array(value) for name, value in arrays.items()
        }

    def set_state(self, state: State) -> None:
        n, lanes = self._size, self._lanes
        given = Given(state, lanes, n)
        bits = given.integer("bits", min(given.step, self._order))
        size = lanes * 2**bits
        x, p = given.array("x", np.float64, n, size), given.array("P", np.float64, n, n, size)
        score, fates = given.array("score", np.float64, size), fates_of(self._model.law)
        fates.set_state(given, bits, lanes)
        given.end()
        self._k, self._bits, self._score, self._fates = given.step, bits, score, fates
        self._x, self._p = list(x), symmetric(n, lambda i, j: p[i, j])

    def start_from(self, step: int, x_hat: Floats, P: Floats) -> None:
        n, lanes, model = self._model.n, self._lanes, self._model
        refuse_moments(model, step)
        start_of(step, x_hat, P, lanes, n)
        self._x, self._p = [x_hat[:, i].copy() for i in range(n)], symmetric(n, lambda i, j: P[:, i, j].copy())
        if model.holds:
            nothing = [np.zeros(lanes) for _ in range(model.q)]
            self._x, self._p = _mapped(partial(_array, size=lanes), with_input(self._x, self._p, nothing))
        self._k, self._bits, self._score = step, 0, np.zeros(lanes)
        self._fates.start_from(step, lanes)

    def _learn(self, ack: Ack) -> None:
        """Bar the hypotheses that an ACK of an older packet contradicts."""
        age = self._k - 2 - ack.j
        if age < 0:
            return
        if age >= self._bits:
            self.counters["late_acks"] = self.counters.get("late_acks", 0) + int(np.count_nonzero(ack.known))
            return
        fate = np.arange(2**self._bits)[:, None] >> (self._bits - 1 - age) & 1
        contradicted = ack.known.astype(np.bool_) & (fate != ack.nu)
        self._score = self._score + np.where(contradicted, IMPOSSIBLE, 0.0).ravel()

    def _priors(self, acks: tuple[Ack, ...]) -> list[Floats]:
        """log P(ν_{k−1} = 0 | hypothesis) and log P(ν_{k−1} = 1 | hypothesis), with the ACK of it if one came."""
        size = len(self._score)
        priors = self._fates.priors(size)
        for ack in acks:
            if ack.j == self._k - 1:
                for nu in (0, 1):
                    barred = np.where(ack.known.astype(np.bool_) & (ack.nu != nu), IMPOSSIBLE, 0.0)
                    priors[nu] = priors[nu] + np.tile(barred, size // self._lanes)
        return priors

    def _level(self) -> None:
        scores = self._score.reshape(-1, self._lanes)
        self._score = (scores - scores.max(axis=0)).ravel()

    def _forget(self) -> None:
        """Merge the pairs that differ in the oldest bit alone."""
        every = self._x, self._p, self._score
        even, odd = (_mapped(partial(_oldest, bit=bit, lanes=self._lanes), every) for bit in (0, 1))
        self._fates.merge(even[2], odd[2], self._lanes)
        self._x, self._p, self._score = _pairs_merged(self._model, even, odd)
        self._bits -= 1

    def _moments(self) -> Estimate:
        """Mean and covariance of the mixture, merged in pairs down to one Gaussian."""
        x, p, score = self._x, self._p, self._score
        while len(score) > self._lanes:
            low, high = (_mapped(partial(_half, upper=upper), (x, p, score)) for upper in (False, True))
            x, p, score = _pairs_merged(self._model, low, high)
        if self._model.holds:
            x, p = of_state(self._model, x, p)
        if self._lanes == 1:
            x, p = _mapped(_number, x), _mapped(_number, p)
        return Estimate(x, p, self._lanes)


def _advance(
    model: Model, gamma: Mask, x: Vector, P: Matrix, shift: Vector, y: Vector
) -> tuple[Vector, Vector, Matrix, Component, Component]:
    """x̂ for ν = 0 and for ν = 1, their common P, and the log-likelihoods of both."""
    idle = constant_times(model.a, x)
    covariance = predict(model.a, P, model.noise)
    gain = Gain(covariance, model.c, model.sensor_noise)
    lost: Component = 0.0
    delivered: Component = 0.0
    if any_of(gamma):
        innovation = subtract(y, constant_times(model.c, idle))
        density = gain.innovation.log_density(innovation)
        lost = where(gamma, density, 0.0)
        delivered = where(gamma, density + log_odds(gain, shift, innovation), 0.0)
        idle, shift = (
            where_vector(gamma, gain.correct(idle, y), idle),
            where_vector(gamma, gain.propagate(shift), shift),
        )
    return idle, add(idle, shift), phi(covariance, gain, gamma), lost, delivered


def _advance_held(
    model: Model, gamma: Mask, z: Vector, P: Matrix, u: Vector, y: Vector
) -> tuple[Vector, Vector, Matrix, Matrix, Component, Component]:
    """The mean of (x, a) for ν = 0 and for ν = 1, their covariances, and the log-likelihoods of both."""
    (idle, first, lost), (moved, second, delivered) = kept(model, gamma, z, P, y), renewed(model, gamma, z, P, u, y)
    return idle, moved, first, second, lost, delivered


def _merge(x: Vector, P: Matrix, score: Component, z: Vector, R: Matrix, other: Component) -> Part:
    return all_merged([(x, P, score), (z, R, other)])


def _shapes(model: Model) -> tuple[Shape, Shape, Shape]:
    return ("vector", size_of(model)), ("symmetric", size_of(model)), ("scalar", 1)


@lru_cache(maxsize=16)
def _stepper(model: Model, lanes: int) -> Step:
    mean: Shape = ("vector", model.n)
    covariance: Shape = ("symmetric", model.n)
    number: Shape = ("scalar", 1)
    arguments: tuple[Shape, ...] = (mean, covariance, mean, ("vector", model.p))
    return masked_step(partial(_advance, model), arguments, (mean, mean, covariance, number, number), lanes)


@lru_cache(maxsize=16)
def _held_stepper(model: Model, lanes: int) -> Step:
    mean, covariance, number = _shapes(model)
    arguments: tuple[Shape, ...] = (mean, covariance, ("vector", model.q), ("vector", model.p))
    results: tuple[Shape, ...] = (mean, mean, covariance, covariance, number, number)
    return masked_step(partial(_advance_held, model), arguments, results, lanes)


@lru_cache(maxsize=16)
def _merger(model: Model, lanes: int) -> Callable[..., tuple[Any, ...]]:
    shapes = _shapes(model)
    return many_lanes(_merge, (*shapes, *shapes), shapes, lanes)


def _pairs_merged(model: Model, first: Part, second: Part) -> Part:
    x, p, score = _merger(model, _kind(len(first[2])))(*first, *second)
    return x, p, score


def _kind(size: int) -> int:
    """A number of lanes for which the code is the same as for ``size``."""
    return 1 if size == 1 else 2 if size < LANES_MIN else LANES_MIN


def _half(component: Floats, upper: bool) -> Floats:
    half = len(component) // 2
    return component[half:] if upper else component[:half]


def _oldest(component: Floats, bit: int, lanes: int) -> Floats:
    """The hypotheses whose oldest bit is ``bit``."""
    return component.reshape(-1, 2, lanes)[:, bit].ravel()


def _repeated(array: Floats, size: int) -> Vector:
    """Components of an array (M, n), each as often as there are hypotheses."""
    return [np.tile(column, size // array.shape[0]) for column in np.ascontiguousarray(array.T)]


def _mapped(function: Callable[[Any], Any], value: Any) -> Any:
    """``function`` of every component in lists and tuples of them."""
    if isinstance(value, list | tuple):
        return type(value)(_mapped(function, entry) for entry in value)
    return function(value)


def _number(component: Floats) -> float:
    return float(component[0])


def _array(component: Component, size: int) -> Floats:
    return np.broadcast_to(np.asarray(component, dtype=np.float64), size)
