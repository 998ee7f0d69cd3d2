"""AOE and GPB in numpy as one writes them with batches of small matrices: (M, n) means, (M, n, n) covariances."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from testbed.estimator.model import Model

Floats = NDArray[np.float64]
Result = tuple[Floats, Floats]


def aoe(model: Model, u: Floats, y: Floats, arrived: NDArray[np.bool_]) -> Result:
    """theory.md 3.4: u (T, q), y (T, M, p), arrived (T, M) → x̂ (T, M, n), P (T, M, n, n)."""
    steps, lanes = arrived.shape
    chain = model.control
    x, P = np.tile(model.x0_mean, (lanes, 1)), np.tile(model.P0, (lanes, 1, 1))
    weights = np.tile([1.0 - chain.start, chain.start], (lanes, 1))
    x_hat, covariance = np.empty((steps, lanes, model.n)), np.empty((steps, lanes, model.n, model.n))
    for k in range(steps):
        if k:
            weights = weights @ _transitions(model)
        means = _split(model, x, u[k])  # (M, 2, n)
        P = model.A @ P @ model.A.T + model.Q
        means, P, log_likelihood = _observe(model, means, P[:, None], y[k][:, None], arrived[k][:, None])
        weights = _normalised(np.log(weights) + log_likelihood)
        x, P = _merge(weights, means, P)
        x_hat[k], covariance[k] = x, P
    return x_hat, covariance


def gpb(model: Model, order: int, u: Floats, y: Floats, arrived: NDArray[np.bool_]) -> Result:
    """theory.md 3.5, order ≥ 1: hypotheses (M, H, …), the newest ν in the last bit of the number."""
    steps, lanes = arrived.shape
    n, chain = model.n, model.control
    means, P = np.tile(model.x0_mean, (lanes, 1, 1)), np.tile(model.P0, (lanes, 1, 1, 1))
    log_weights = np.zeros((lanes, 1))
    x_hat, covariance = np.empty((steps, lanes, n)), np.empty((steps, lanes, n, n))
    transitions = np.log(_transitions(model))
    for k in range(steps):
        hypotheses = means.shape[1]
        prior = transitions[np.arange(hypotheses) % 2] if k else np.log([[1.0 - chain.start, chain.start]])
        log_weights = (log_weights[:, :, None] + prior).reshape(lanes, -1)
        means = _split(model, means, u[k]).reshape(lanes, -1, n)
        P = np.repeat(model.A @ P @ model.A.T + model.Q, 2, axis=1)
        means, P, log_likelihood = _observe(model, means, P, y[k][:, None], arrived[k][:, None])
        weights = _normalised(log_weights + log_likelihood)
        x_hat[k], covariance[k] = _merge(weights, means, P)
        if means.shape[1] > 2**order:  # merge what differs in the oldest bit alone
            pairs = weights.reshape(lanes, 2, -1).transpose(0, 2, 1)
            total = pairs.sum(axis=2)
            means, P = _merge(
                pairs / total[:, :, None],
                means.reshape(lanes, 2, -1, n).transpose(0, 2, 1, 3),
                P.reshape(lanes, 2, -1, n, n).transpose(0, 2, 1, 3, 4),
            )
            weights = total
        log_weights = np.log(weights)
    return x_hat, covariance


def _transitions(model: Model) -> Floats:
    """P(ν_k = column | ν_{k−1} = row)."""
    chain = model.control
    return np.array([[1.0 - chain.recovery, chain.recovery], [chain.failure, 1.0 - chain.failure]])


def _split(model: Model, x: Floats, u: Floats) -> Floats:
    """A x and A x + B u, side by side in a new axis before the last."""
    assert model.B is not None
    idle = x @ model.A.T
    return np.stack([idle, idle + model.B @ u], axis=-2)


def _observe(
    model: Model, means: Floats, P: Floats, y: Floats, arrived: NDArray[np.bool_]
) -> tuple[Floats, Floats, Floats]:
    """Means (M, H, n) and P (M, 1 or H, n, n) after the update, and the log-likelihoods (M, H)."""
    C, R = model.C, model.R
    S = C @ P @ C.T + R
    inverse = np.linalg.inv(S)
    K = np.where(arrived[..., None, None], P @ C.T @ inverse, 0.0)
    e = (y - means @ C.T)[..., None]
    quadratic = (e.swapaxes(-1, -2) @ inverse @ e)[..., 0, 0]
    log_likelihood = np.where(arrived, -0.5 * (quadratic + np.log(np.linalg.det(S))), 0.0)
    left = np.eye(model.n) - K @ C
    updated = left @ P @ left.swapaxes(-1, -2) + K @ R @ K.swapaxes(-1, -2)
    return means + (K @ e)[..., 0], updated, log_likelihood


def _normalised(log_weights: Floats) -> Floats:
    weights = np.exp(log_weights - log_weights.max(axis=1, keepdims=True))
    return weights / weights.sum(axis=1, keepdims=True)


def _merge(weights: Floats, means: Floats, P: Floats) -> Result:
    """Moments over the last axis of the weights; P may be common to all."""
    mean = (weights[..., None] * means).sum(axis=-2)
    away = means - mean[..., None, :]
    spread = away[..., :, None] * away[..., None, :]
    return mean, (weights[..., None, None] * (P + spread)).sum(axis=-3)
