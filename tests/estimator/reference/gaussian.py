"""KFIO, OE and the bounds, for one lane and one step k, by conditioning the stacked Gaussian."""

from __future__ import annotations

import numpy as np
from scipy.special import logsumexp

from estimator.reference.cases import Bools, Floats, Ints, System
from estimator.reference.histories import weighted_histories
from estimator.reference.stacked import Stack

Estimate = tuple[Floats, Floats]


def mixture_moments(weights: Floats, means: Floats, cov: Floats) -> Estimate:
    """Mean (n,) and covariance (n, n) of the mixture Σ weights_i N(means_i, cov)."""
    mean = weights @ means
    away = means - mean
    return mean, cov + (away * weights[:, None]).T @ away


def kfio(system: System, u: Floats, y: Floats, arrived: Bools, nu: Ints) -> Estimate:
    """Moments of x_k given the received y and all of ν; u (k, q), y (k, p), arrived (k,), nu (k,)."""
    stack = Stack(system, arrived)
    history = np.asarray(nu, dtype=float)[None, :]
    return stack.posterior_means(u, y, history)[0], stack.cov


def oe(system: System, u: Floats, y: Floats, arrived: Bools, known: dict[int, int]) -> Estimate:
    """Moments of x_k given the received y and the known ν_j: the sum over all histories."""
    stack = Stack(system, arrived)
    histories, priors = weighted_histories(system, len(u), known)
    logs = np.log(priors) + stack.log_densities(u, y, histories)
    return mixture_moments(np.exp(logs - logsumexp(logs)), stack.posterior_means(u, y, histories), stack.cov)


def log_evidence_of_lanes(system: System, u: Floats, y: Floats, arrived: Bools) -> Floats:
    """log p(received y) with no ACK, for many y at once: u (k, q), y (k, M, p), arrived (k,) → (M,)."""
    histories, priors = weighted_histories(system, len(u), {})
    stack = Stack(system, arrived)
    logs = [np.log(prior) + stack.log_densities_of_lanes(u, y, h) for prior, h in zip(priors, histories, strict=True)]
    return np.asarray(logsumexp(logs, axis=0), dtype=np.float64)


def lower_bound(system: System, arrived: Bools) -> Floats:
    """Covariance of x_k given the received y when ν is known: it depends on arrived only."""
    return Stack(system, arrived).cov


def upper_bound(system: System, arrived: Bools, U: Floats) -> Floats:
    """The same of the system whose process noise has covariance Q + U / 4 (M Theorem 3)."""
    return Stack(system, arrived, U / 4).cov
