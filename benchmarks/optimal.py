"""The optimal estimator to a tolerance on system F (theory.md 5), and the exact posterior by all histories."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from testbed.channel.loss import Chain
from testbed.errors import TestbedError
from testbed.estimator.model import Model
from testbed.estimator.registry import create

KIND = "oe"
Floats = NDArray[np.float64]
Result = tuple[Floats, Floats]


@dataclass(frozen=True)
class Outcome:
    """Seconds of the steps that were done; the largest certified bounds on x̂ and P; why it ended early, or ""."""

    seconds: float
    steps: int
    bound: float
    bound_P: float
    x_hat: Floats
    P: Floats
    stopped: str = ""


def system(n: int = 2) -> Model:
    """F's, with control packets lost at 0.2; for n = 1 its second state, for n = 3 with a third."""
    A = np.array([[0.9, 0.1, 0.0], [-0.1, 0.8, 0.1], [0.0, -0.1, 0.7]])
    B, C, Q = np.array([[-1.0], [1.0], [0.5]]), np.array([[0.0, 1.0, 0.0]]), np.diag([1.0, 2.0, 1.0])
    keep = {1: [1], 2: [0, 1], 3: [0, 1, 2]}[n]
    return Model(
        A=A[np.ix_(keep, keep)],
        B=B[keep],
        C=C[:, keep],
        Q=Q[np.ix_(keep, keep)],
        R=np.eye(1),
        x0_mean=np.zeros(n),
        P0=np.eye(n),
        control=Chain.bernoulli(0.8),
    )


def trial(model: Model, steps: int, seed: int = 1) -> Result:
    """A bounded control u (T, 1) and observations y (T, 1) without losses."""
    rng = np.random.default_rng(seed)
    assert model.B is not None
    u = 2.0 * np.sin(0.3 * np.arange(steps))[:, None] + 1.0
    x, y = np.zeros(model.n), np.empty((steps, 1))
    for k in range(steps):
        nu = rng.random() < model.control.start
        x = model.A @ x + nu * (model.B @ u[k]) + np.sqrt(np.diag(model.Q)) * rng.normal(size=model.n)
        y[k] = model.C @ x + rng.normal(size=1)
    return u, y


def run(model: Model, given: Result, tolerance: float, limit_s: float) -> Outcome:
    """One lane, until done, refused or out of time."""
    u, y = given
    arrived, begun, stopped = np.array([True]), time.perf_counter(), ""
    bound = bound_P = 0.0
    means, covariances = [], []
    try:
        estimator = create(KIND, model, lanes=1, options={"tolerance": tolerance})
        begun = time.perf_counter()
        for k in range(len(u)):
            estimate = estimator.step(u[k : k + 1], y[k : k + 1], arrived)
            means.append(estimate.x_hat[0])
            covariances.append(estimate.P[0])
            bound = max(bound, _largest(estimate.error_bound))
            bound_P = max(bound_P, _largest(estimate.error_bound_P))
            if time.perf_counter() - begun > limit_s:
                stopped = f"more than {limit_s:g} s" if k + 1 < len(u) else ""
                break
    except TestbedError as error:
        stopped = str(error)
    seconds = time.perf_counter() - begun
    return Outcome(seconds, len(means), bound, bound_P, np.array(means), np.array(covariances), stopped)


def breadth_first(model: Model, given: Result) -> Result:
    """Moments at every step from all 2^k histories, held at once."""
    mean, covariance, weights = model.x0_mean[:, None], model.P0, np.ones(1)
    out = []
    for y, step in zip(given[1], _gains(model, given), strict=True):
        covariance = step.covariance
        moved = model.A @ mean
        mean = np.concatenate([moved, moved + step.push[:, None]], axis=1)
        weights = np.concatenate([weights * (1.0 - model.control.start), weights * model.control.start])
        e = y - model.C @ mean
        weights *= np.exp(-0.5 * e[0] ** 2 / step.S)
        weights /= weights.sum()
        mean = mean + step.K @ e
        out.append(_moments(weights, mean, covariance))
    return np.array([x for x, _ in out]), np.array([P for _, P in out])


def depth_first(model: Model, given: Result) -> Callable[[], Result] | None:
    """The same with no memory to speak of, history by history; None without numba. Independent losses, one sensor."""
    try:
        import numba
    except ImportError:
        return None
    steps = _gains(model, given)
    n, last = model.n, len(steps)
    pushes = np.array([s.push for s in steps])
    gains = np.array([s.K[:, 0] for s in steps])
    S, y = np.array([s.S for s in steps]), given[1][:, 0]
    A, C = model.A.copy(), model.C[0].copy()
    log_prior = np.log([1.0 - model.control.start, model.control.start])

    @numba.njit(error_model="numpy")  # type: ignore[untyped-decorator]
    def visit() -> tuple[Floats, Floats, Floats]:
        totals, first, second = np.zeros(last), np.zeros((last, n)), np.zeros((last, n, n))
        means, scores = np.zeros((last + 1, n)), np.zeros(last + 1)
        means[0] = start
        choice = np.zeros(last, dtype=np.int64)
        k = 0
        while k >= 0:
            if k == last or choice[k] == 2:
                if k < last:
                    choice[k] = 0
                k -= 1
                continue
            nu = choice[k]
            choice[k] += 1
            e = y[k]
            for i in range(n):
                total = nu * pushes[k, i]
                for j in range(n):
                    total += A[i, j] * means[k, j]
                means[k + 1, i] = total
                e -= C[i] * total
            for i in range(n):
                means[k + 1, i] += gains[k, i] * e
            scores[k + 1] = scores[k] + log_prior[nu] - 0.5 * e * e / S[k]
            weight = np.exp(scores[k + 1])
            totals[k] += weight
            for i in range(n):
                first[k, i] += weight * means[k + 1, i]
                for j in range(n):
                    second[k, i, j] += weight * means[k + 1, i] * means[k + 1, j]
            k += 1
        return totals, first, second

    start = model.x0_mean.copy()
    covariances = np.array([s.covariance for s in steps])

    def moments() -> Result:
        totals, first, second = visit()
        x = first / totals[:, None]
        return x, covariances + second / totals[:, None, None] - x[:, :, None] * x[:, None, :]

    return moments


@dataclass(frozen=True)
class _Gain:
    push: Floats
    K: Floats
    S: float
    covariance: Floats


def _gains(model: Model, given: Result) -> list[_Gain]:
    """What all histories have in common (theory.md 3.2): one sensor, no observation lost."""
    P, out = model.P0, []
    assert model.B is not None
    for u in given[0]:
        P = model.A @ P @ model.A.T + model.Q
        S = model.C @ P @ model.C.T + model.R
        K = P @ model.C.T / S
        left = np.eye(model.n) - K @ model.C
        P = left @ P @ left.T + K @ model.R @ K.T
        out.append(_Gain(model.B @ u, K, float(S[0, 0]), P))
    return out


def _moments(weights: Floats, mean: Floats, covariance: Floats) -> Result:
    x = mean @ weights
    away = mean - x[:, None]
    return x, covariance + (weights * away) @ away.T


def _largest(bound: Floats | None) -> float:
    return float("nan") if bound is None else float(bound.max())
