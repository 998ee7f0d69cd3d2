"""All histories of control losses, with their prior probabilities."""

from __future__ import annotations

from itertools import product

import numpy as np

from estimator.reference.cases import Floats, System


def weighted_histories(system: System, k: int, known: dict[int, int]) -> tuple[Floats, Floats]:
    """Histories (N, k) of ν_0 … ν_{k-1} that agree with `known` and can happen, and their priors (N,), summing to 1."""
    kept: list[tuple[int, ...]] = []
    priors: list[float] = []
    for history in product((0, 1), repeat=k):
        if any(history[j] != nu for j, nu in known.items()):
            continue
        prior = system.prior(history)
        if prior > 0:
            kept.append(history)
            priors.append(prior)
    if not kept:
        raise ValueError(f"no history agrees with {known}")
    return np.array(kept, dtype=float).reshape(len(kept), k), np.array(priors) / sum(priors)
