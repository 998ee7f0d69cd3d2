"""LMMSE by its definition: the regression of x_k on what was received, from second moments over all histories."""

from __future__ import annotations

import numpy as np

from estimator.reference.cases import Bools, Floats, System
from estimator.reference.gaussian import Estimate
from estimator.reference.stacked import Stack


def lmmse(system: System, u: Floats, y: Floats, arrived: Bools, known: dict[int, int]) -> Estimate:
    """The best estimate of x_k that is affine in the received y, and the covariance of its error; one lane.

    ν_j of the packets in ``known`` counts as given, the others as independent of it with their prior.
    """
    k = len(u)
    stack = Stack(system, arrived)
    histories, priors = _independent_histories(system, k, known)
    state = stack.state_means(u, histories, k)
    output = stack.output_means(u, histories)
    mean_x, mean_y = priors @ state, priors @ output
    dx, dy = state - mean_x, output - mean_y
    weighted = dy * priors[:, None]
    cov_xx = stack.X @ stack.noise_cov @ stack.X.T + (dx * priors[:, None]).T @ dx
    cov_yy = stack.S + weighted.T @ dy
    cov_xy = stack.X @ stack.noise_cov @ stack.H.T + dx.T @ weighted
    gain = np.linalg.solve(cov_yy, cov_xy.T).T
    received = np.concatenate([np.zeros(0), *(y[j - 1] for j in stack.received)])
    rest_x = stack.X - gain @ stack.H
    rest = dx - dy @ gain.T
    cov = rest_x @ stack.noise_cov @ rest_x.T + (rest * priors[:, None]).T @ rest
    assert np.allclose(cov, cov_xx - gain @ cov_xy.T)
    return mean_x + gain @ (received - mean_y), cov


def _independent_histories(system: System, k: int, known: dict[int, int]) -> tuple[Floats, Floats]:
    histories = np.array(np.meshgrid(*[[0.0, 1.0]] * k, indexing="ij")).reshape(k, -1).T
    rates = np.array([float(known.get(j, system.start)) for j in range(k)])
    return histories, np.prod(np.where(histories == 1.0, rates, 1.0 - rates), axis=1)
