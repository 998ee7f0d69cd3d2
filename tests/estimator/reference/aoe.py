"""AOE by its definition (M Theorem 2): two joint Gaussians of (x_k, y_k) a step, then one with their moments."""

from __future__ import annotations

import numpy as np
from scipy.stats import multivariate_normal

from estimator.reference.cases import Bools, Floats, System
from estimator.reference.gaussian import Estimate, mixture_moments


def _condition(mean: Floats, cov: Floats, y: Floats) -> tuple[Floats, Floats, float]:
    """Split N(mean, cov) of (x, y) at the given y: mean and covariance of x given y, and log p(y)."""
    p = len(y)
    n = len(mean) - p
    xx, xy, yy = cov[:n, :n], cov[:n, n:], cov[n:, n:]
    posterior_mean = mean[:n] + xy @ np.linalg.solve(yy, y - mean[n:])
    posterior_cov = xx - xy @ np.linalg.solve(yy, xy.T)
    return posterior_mean, posterior_cov, float(multivariate_normal(mean[n:], yy).logpdf(y))


def aoe(system: System, u: Floats, y: Floats, arrived: Bools, known: dict[int, int]) -> list[Estimate]:
    """Estimates of steps 1 … K of one lane; known: {j: ν_j} of the packets known in time (at step j + 1)."""
    A, B, C, n = system.A, system.B, system.C, system.n
    mean, cov = system.x0_mean, system.P0
    last: tuple[float, float] | None = None
    estimates = []
    for k in range(1, len(u) + 1):
        arrival = system.start if last is None else last[0] * system.arrival(0) + last[1] * system.arrival(1)
        prior = [1.0 - arrival, arrival]
        if k - 1 in known:
            prior = [float(known[k - 1] == 0), float(known[k - 1] == 1)]
        predicted_cov = A @ cov @ A.T + system.Q
        logs, means = np.full(2, -np.inf), np.zeros((2, n))
        for nu in (0, 1):
            if prior[nu] == 0:
                continue
            means[nu] = A @ mean + nu * B @ u[k - 1]
            logs[nu] = np.log(prior[nu])
            common = predicted_cov
            if arrived[k - 1]:
                joint_mean = np.concatenate([means[nu], C @ means[nu]])
                joint_cov = np.block(
                    [[predicted_cov, predicted_cov @ C.T], [C @ predicted_cov, C @ predicted_cov @ C.T + system.R]]
                )
                means[nu], common, log_density = _condition(joint_mean, joint_cov, y[k - 1])
                logs[nu] += log_density
        weights = np.exp(logs - logs.max())
        weights /= weights.sum()
        mean, cov = mixture_moments(weights, means, common)
        last = (float(weights[0]), float(weights[1]))
        estimates.append((mean, cov))
    return estimates
