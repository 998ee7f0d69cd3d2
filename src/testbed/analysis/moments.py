"""Which moments of the error covariance are finite under correlated observation losses."""

from __future__ import annotations

import math

import numpy as np

from testbed.channel.law import LossModel
from testbed.numerics.lanes import Floats


def spectral_radius(A: Floats) -> float:
    """ρ(A), A (n, n)."""
    return float(np.max(np.abs(np.linalg.eigvals(A))))


def finite_moment_order(A: Floats, observation: LossModel) -> float:
    """The order r* up to which moments of the stationary error covariance can be finite: r < r* is necessary.

    In a run of losses the covariance grows by ρ(A)² a step, and P(m losses in a row) falls like θ^m, θ = burst_decay,
    so that its r-th moment needs ρ^{2r} θ < 1. For a Markov chain θ = 1 − recovery (P Corollary 9: necessary and
    sufficient for scalar systems). Infinite for ρ ≤ 1 or where a loss is never followed by another.
    """
    rho, persistence = spectral_radius(A), observation.burst_decay
    if rho <= 1.0 or persistence <= 0.0 or observation.never_loses:
        return math.inf
    return -math.log(persistence) / (2.0 * math.log(rho)) if persistence < 1.0 else 0.0
