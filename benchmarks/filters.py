"""KFIO as users of the testbed, of other libraries and of plain numpy run it: one problem, one form of result."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from importlib import import_module
from typing import Any

import numpy as np
from numpy.typing import NDArray

from testbed.channel.loss import Chain, LossProcess
from testbed.estimator.kfio_block import Block, filter_block
from testbed.estimator.model import Model
from testbed.estimator.registry import create
from testbed.numerics.streams import Stream

Floats = NDArray[np.float64]
Result = tuple[Floats, Floats]
"""x̂ (T, M, n) and P (T, M, n, n)."""


@dataclass(frozen=True)
class Problem:
    """y (T, M, p) and arrived (T, M), steps first as a service gets them; the same with the lanes last."""

    model: Model
    y: Floats
    arrived: NDArray[np.bool_]

    @property
    def lanes(self) -> int:
        return int(self.arrived.shape[1])

    @property
    def steps(self) -> int:
        return int(self.arrived.shape[0])

    def first(self, lanes: int) -> Problem:
        """Its first lanes alone."""
        return replace(self, y=self.y[:, :lanes].copy(), arrived=self.arrived[:, :lanes].copy())


def problem(steps: int, lanes: int) -> Problem:
    """2 states, 2 sensors, no control; Markov losses of observations, other ones in each lane."""
    model = Model(
        A=np.array([[0.9, 0.1], [-0.1, 0.8]]),
        C=np.array([[1.0, 0.3], [-0.2, 1.0]]),
        Q=np.array([[1.0, 0.2], [0.2, 2.0]]),
        R=np.array([[1.0, 0.1], [0.1, 0.5]]),
        x0_mean=np.array([1.0, -1.0]),
        P0=np.eye(2),
    )
    losses = LossProcess(Chain.markov(0.5, 0.2), Stream(1, "benchmark", "loss", width=1, lane=0, lanes=lanes), lanes)
    rng = np.random.default_rng(1)
    w, v = np.linalg.cholesky(model.Q), np.linalg.cholesky(model.R)
    x = model.x0_mean + rng.normal(size=(lanes, 2))
    y, arrived = np.empty((steps, lanes, 2)), np.empty((steps, lanes), dtype=np.bool_)
    for k in range(steps):
        x = x @ model.A.T + rng.normal(size=(lanes, 2)) @ w.T
        y[k] = x @ model.C.T + rng.normal(size=(lanes, 2)) @ v.T
        arrived[k] = losses.next(k)
    return Problem(model, y, arrived)


def ours_step_by_step(given: Problem) -> Callable[[], Result]:
    """The estimator as a service runs it, x̂ and P taken from every step."""
    u = np.zeros((given.lanes, 0))

    def run() -> Result:
        estimator = create("kfio", given.model, lanes=given.lanes)
        out = [estimator.step(u, y, arrived) for y, arrived in zip(given.y, given.arrived, strict=True)]
        return np.array([e.x_hat for e in out]), np.array([e.P for e in out])

    return run


def timed_step_by_step(given: Problem) -> Callable[[], None]:
    """The same without keeping all estimates."""
    u = np.zeros((given.lanes, 0))

    def run() -> None:
        estimator = create("kfio", given.model, lanes=given.lanes)
        for y, arrived in zip(given.y, given.arrived, strict=True):
            estimate = estimator.step(u, y, arrived)
            estimate.x_hat  # noqa: B018
            estimate.P  # noqa: B018

    return run


class OursBlock:
    """``filter_block`` over equal parts of the lanes, one a thread; and the copy of as much memory in the same layout.

    The copy reads every y and γ and writes x̂ and P. fresh: both into new memory, else over the last result.
    """

    def __init__(self, given: Problem, *, threads: int = 1, fresh: bool = False) -> None:
        self._model, self._fresh, self._pool = given.model, fresh, ThreadPoolExecutor(threads)
        self._y = [np.ascontiguousarray(part.transpose(0, 2, 1)) for part in np.array_split(given.y, threads, axis=1)]
        self._arrived = [np.ascontiguousarray(part) for part in np.array_split(given.arrived, threads, axis=1)]
        self._kept = [self._empty(part) for part in self._arrived]

    def run(self) -> list[Block]:
        return list(self._pool.map(self._filter, self._y, self._arrived, self._kept))

    def copy(self) -> None:
        list(self._pool.map(self._copy, self._y, self._arrived, self._kept))

    def result(self) -> Result:
        blocks = self.run()
        x_hat = np.concatenate([block.x_hat for block in blocks], axis=2).transpose(0, 2, 1)
        return x_hat, np.concatenate([block.P for block in blocks], axis=3).transpose(0, 3, 1, 2)

    def _empty(self, arrived: NDArray[np.bool_]) -> Block:
        return Block.empty(self._model, *arrived.shape)

    def _filter(self, y: Floats, arrived: NDArray[np.bool_], kept: Block) -> Block:
        return filter_block(self._model, y, arrived, out=None if self._fresh else kept)

    def _copy(self, y: Floats, arrived: NDArray[np.bool_], kept: Block) -> None:
        room = self._empty(arrived) if self._fresh else kept
        np.count_nonzero(arrived)
        np.copyto(room.x_hat, y)
        room.P_upper[:] = 1.0


def numpy_batched(given: Problem) -> Result:
    """Batches of small matrices with ``matmul`` and ``inv``."""
    model, lanes, n = given.model, given.lanes, given.model.n
    A, C, Q, R, identity = model.A, model.C, model.Q, model.R, np.eye(given.model.n)
    x, P = np.tile(model.x0_mean[:, None], (lanes, 1, 1)), np.tile(model.P0, (lanes, 1, 1))
    x_hat, covariance = np.empty((given.steps, lanes, n)), np.empty((given.steps, lanes, n, n))
    for k in range(given.steps):
        x, P = A @ x, A @ P @ A.T + Q
        K = P @ C.T @ np.linalg.inv(C @ P @ C.T + R)
        K[~given.arrived[k]] = 0.0
        left = identity - K @ C
        x = x + K @ (given.y[k][:, :, None] - C @ x)
        P = left @ P @ left.transpose(0, 2, 1) + K @ R @ K.transpose(0, 2, 1)
        x_hat[k], covariance[k] = x[:, :, 0], P
    return x_hat, covariance


def filterpy(given: Problem) -> Result:
    from filterpy.kalman import KalmanFilter

    model = given.model
    out = _room(given)
    for lane in range(given.lanes):
        one = KalmanFilter(dim_x=model.n, dim_z=model.p)
        one.F, one.H, one.Q, one.R, one.x, one.P = model.A, model.C, model.Q, model.R, model.x0_mean, model.P0
        for k in range(given.steps):
            one.predict()
            one.update(given.y[k, lane] if given.arrived[k, lane] else None)
            out[0][k, lane], out[1][k, lane] = one.x, one.P
    return out


def pykalman(given: Problem) -> Result:
    from pykalman import KalmanFilter

    model, out = given.model, _room(given)
    mean, covariance = _first_prediction(model)
    for lane in range(given.lanes):
        one = KalmanFilter(model.A, model.C, model.Q, model.R, None, None, mean, covariance)
        lost = np.repeat(~given.arrived[:, lane, None], model.p, axis=1)
        out[0][:, lane], out[1][:, lane] = one.filter(np.ma.masked_array(given.y[:, lane], lost))
    return out


def statsmodels(given: Problem) -> Result:
    """A new filter object for every lane: one that is bound again keeps covariances of other losses."""
    from statsmodels.tsa.statespace.kalman_filter import KalmanFilter

    model, out = given.model, _room(given)
    mean, covariance = _first_prediction(model)
    data = _with_gaps(given)
    for lane in range(given.lanes):
        one = KalmanFilter(k_endog=model.p, k_states=model.n, tolerance=0.0)
        one.bind(np.ascontiguousarray(data[:, lane]))
        one["design"], one["transition"], one["selection"] = model.C, model.A, np.eye(model.n)
        one["obs_cov"], one["state_cov"] = model.R, model.Q
        one.initialize_known(mean, covariance)
        found = one.filter()
        out[0][:, lane], out[1][:, lane] = found.filtered_state.T, found.filtered_state_cov.transpose(2, 0, 1)
    return out


def simdkalman(given: Problem) -> Result:
    """All lanes in one call."""
    from simdkalman import KalmanFilter

    model = given.model
    mean, covariance = _first_prediction(model)
    filters = KalmanFilter(model.A, model.Q, model.C, model.R)
    data = _with_gaps(given).transpose(1, 0, 2)
    settings: dict[str, Any] = {"smoothed": False, "filtered": True, "observations": False}
    states = filters.compute(data, 0, mean, covariance, **settings).filtered.states
    return states.mean.transpose(1, 0, 2), states.cov.transpose(1, 0, 2, 3)


LIBRARIES = {"filterpy": filterpy, "pykalman": pykalman, "simdkalman": simdkalman, "statsmodels": statsmodels}


def installed() -> Iterator[tuple[str, Callable[[Problem], Result] | None]]:
    """Every library, with None where it is missing."""
    for name, run in LIBRARIES.items():
        try:
            import_module(name)
        except ImportError:
            yield name, None
        else:
            yield name, run


def _room(given: Problem) -> Result:
    n = given.model.n
    return np.empty((given.steps, given.lanes, n)), np.empty((given.steps, given.lanes, n, n))


def _with_gaps(given: Problem) -> Floats:
    return np.where(given.arrived[:, :, None], given.y, np.nan)


def _first_prediction(model: Model) -> Result:
    """Where a library begins at the first observation."""
    return model.A @ model.x0_mean, model.A @ model.P0 @ model.A.T + model.Q
