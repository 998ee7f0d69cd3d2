"""FF by its definition: a linear estimator with the ACK gain, and the covariance of its error by enumeration."""

from __future__ import annotations

import numpy as np

from estimator.reference.cases import Bools, Floats, System
from estimator.reference.gaussian import Estimate
from estimator.reference.histories import weighted_histories
from estimator.reference.stacked import Stack


def ff(system: System, u: Floats, y: Floats, arrived: Bools, known: dict[int, int]) -> Estimate:
    """x̃_k of one lane and E[(x_k - x̃_k)(x_k - x̃_k)'] given γ and the ACKs in time, over noises and control losses.

    The gain of step j is the block of y_j in the stacked regression of x_j on all that was received up to j.
    u (k, q), y (k, p), arrived (k,); known: {j: ν_j} of the packets known in time.
    """
    n, p, k = system.n, system.p, len(u)
    histories, priors = weighted_histories(system, k, known)
    applied = np.tensordot(priors, system.applied(u, histories), axes=1)
    offset, weights = system.x0_mean, np.zeros((n, k * p))
    for j in range(1, k + 1):
        offset = system.A @ offset + system.B @ applied[j - 1]
        weights = system.A @ weights
        if arrived[j - 1]:
            gain = Stack(system, arrived[:j]).gain[:, -p:]
            offset = offset - gain @ system.C @ offset
            weights = weights - gain @ system.C @ weights
            weights[:, (j - 1) * p : j * p] += gain
    stack = Stack(system, np.ones(k, dtype=bool))
    from_noise = stack.X - weights @ stack.H
    from_losses = stack.state_means(u, histories, k) - offset - stack.output_means(u, histories) @ weights.T
    cov = from_noise @ stack.noise_cov @ from_noise.T + (from_losses * priors[:, None]).T @ from_losses
    return offset + weights @ y.reshape(-1), cov
