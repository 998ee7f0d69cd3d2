"""What the kit runs estimators on: systems, and what happened on them in a simulation with a fixed seed."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from testbed.channel.gilbert_elliott import GilbertElliott
from testbed.channel.law import Law, LossModel, law_of
from testbed.channel.loss import Chain
from testbed.estimator.hold import applied_inputs
from testbed.estimator.model import Ack, Model
from testbed.numerics.lanes import Floats

MARKOV = Chain.markov(0.6, 0.2)
BERNOULLI = Chain.bernoulli(0.75)
HIDDEN = GilbertElliott.of(0.3, 0.4, loss_good=0.1, loss_bad=0.8)
_ARRAYS = ("u", "y", "arrived", "nu", "x")
_OBSERVATION = Chain.markov(0.7, 0.3)


@dataclass(frozen=True, eq=False)
class Case:
    """K steps on M lanes; row k − 1 is step k, row j of nu packet j.

    u (K, M, q), y (K, M, p), arrived (K, M), nu (K, M) in {0, 1}, x (K, M, n), the truth.
    """

    name: str
    model: Model
    u: Floats
    y: Floats
    arrived: NDArray[np.bool_]
    nu: NDArray[np.int64]
    x: Floats

    @property
    def steps(self) -> int:
        return int(self.u.shape[0])

    @property
    def lanes(self) -> int:
        return int(self.u.shape[1])

    def of_lanes(self, lanes: slice) -> Case:
        """Some of the lanes."""
        return replace(self, **{name: getattr(self, name)[:, lanes] for name in _ARRAYS})

    def first(self, steps: int) -> Case:
        """The first ``steps`` steps."""
        return replace(self, **{name: getattr(self, name)[:steps] for name in _ARRAYS})

    def acks(self, k: int, delays: tuple[int, ...]) -> tuple[Ack, ...]:
        """The ACKs of step k: with delay 0 that of packet k − 1, with delay d that of packet k − 1 − d."""
        everywhere = np.ones(self.lanes, dtype=np.bool_)
        return tuple(Ack(k - 1 - d, self.nu[k - 1 - d].copy(), everywhere.copy()) for d in delays if k - 1 - d >= 0)

    def moved(self, T: Floats) -> Case:
        """The same in the coordinates T x."""
        m, inverse = self.model, np.linalg.inv(T)
        model = replace(
            m,
            A=T @ m.A @ inverse,
            B=None if m.B is None else T @ m.B,
            C=m.C @ inverse,
            Q=_symmetric(T @ m.Q @ T.T),
            x0_mean=T @ m.x0_mean,
            P0=_symmetric(T @ m.P0 @ T.T),
        )
        return replace(self, model=model, x=self.x @ T.T)


def one(control: LossModel) -> Model:
    """n = p = q = 1, unstable."""
    return _model([[1.1]], [[1.0]], [[1.0]], [[0.5]], [[0.4]], control)


def two(control: LossModel) -> Model:
    """n = 2, p = q = 1, stable."""
    return _model([[0.9, 0.1], [-0.1, 0.8]], [[-1.0], [1.0]], [[0.0, 1.0]], [[1.0, 0.2], [0.2, 2.0]], [[1.0]], control)


def three(control: LossModel) -> Model:
    """n = 3, p = q = 2, one unstable eigenvalue."""
    a = [[1.05, 0.3, 0.0], [0.0, 0.8, -0.2], [0.0, 0.3, 0.7]]
    b = [[1.0, 0.0], [0.5, -1.0], [0.0, 2.0]]
    c = [[1.0, 0.0, 0.5], [0.0, 1.0, -1.0]]
    q = [[0.6, 0.1, 0.0], [0.1, 0.5, 0.2], [0.0, 0.2, 0.8]]
    return _model(a, b, c, q, [[0.5, 0.1], [0.1, 0.7]], control)


def simulated(name: str, model: Model, *, steps: int, lanes: int, seed: int, arrivals: bool | None = None) -> Case:
    """u of size 2 or so; arrivals: None for those of the model's chain, else the same at every step."""
    rng = np.random.default_rng(seed)
    u = 2.0 + rng.normal(size=(steps, lanes, model.q))
    nu = _fates(rng, model.law, steps, lanes)
    arrived = _fates(rng, law_of(model.observation), steps, lanes).astype(np.bool_)
    if arrivals is not None:
        arrived[:] = arrivals
    w = _normal(rng, model.Q, (steps, lanes))
    v = _normal(rng, model.R, (steps, lanes))
    x, states = model.x0_mean + _normal(rng, model.P0, (lanes,)), np.empty((steps, lanes, model.n))
    applied = nu[..., None] * u
    if model.holds:
        applied = applied_inputs(u.swapaxes(1, 2), nu).swapaxes(1, 2)
    for k in range(steps):
        push = 0.0 if model.B is None else applied[k] @ model.B.T
        x = states[k] = x @ model.A.T + push + w[k]
    y = states @ model.C.T + v
    y[~arrived] = 0.0
    return Case(name, model, u, y, arrived, nu, states)


def holding(model: Model) -> Model:
    """The same with an actuator that holds the input applied last."""
    return replace(model, on_loss="hold")


def without_control(model: Model) -> Model:
    return replace(model, B=None, control=Chain.lossless())


def _model(a: Any, b: Any, c: Any, q: Any, r: Any, control: LossModel) -> Model:
    n = len(a)
    A, B, C, Q, R = (np.array(matrix, dtype=np.float64) for matrix in (a, b, c, q, r))
    P0 = np.eye(n) + 0.25 * np.ones((n, n))
    return Model(
        A=A, B=B, C=C, Q=Q, R=R, x0_mean=np.arange(1.0, n + 1.0), P0=P0, control=control, observation=_OBSERVATION
    )


def _fates(rng: np.random.Generator, law: Law, steps: int, lanes: int) -> NDArray[np.int64]:
    """1 where a packet arrives, (K, M)."""
    out, weights = np.empty((steps, lanes), dtype=np.int64), np.tile(law.initial, (lanes, 1))
    for k in range(steps):
        state = (rng.random((lanes, 1)) > weights.cumsum(axis=1)).sum(axis=1)
        state = np.minimum(state, len(law.initial) - 1)
        out[k], weights = law.arrived[state], law.transition[state]
    return out


def _normal(rng: np.random.Generator, covariance: Floats, shape: tuple[int, ...]) -> Floats:
    values, vectors = np.linalg.eigh(covariance)
    root = vectors * np.sqrt(np.maximum(values, 0.0))
    return np.asarray(rng.normal(size=(*shape, len(values))) @ root.T)


def _symmetric(S: Floats) -> Floats:
    return (S + S.T) / 2
