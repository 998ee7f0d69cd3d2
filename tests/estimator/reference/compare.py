"""How far two estimates are apart, in the units of the reference."""

from __future__ import annotations

import numpy as np

from estimator.reference.cases import Floats


def covariance_error(P: Floats, reference: Floats) -> float:
    """Largest error of an entry, relative to the largest entry of the reference covariance."""
    scale = max(float(np.abs(reference).max()), 1e-12)
    return float(np.abs(P - reference).max()) / scale


def mean_error(x_hat: Floats, reference: Floats, P: Floats) -> float:
    """Largest error of an entry, relative to the larger of the estimate and its standard deviation."""
    scale = max(float(np.abs(reference).max()), float(np.sqrt(np.abs(P).max())), 1e-12)
    return float(np.abs(x_hat - reference).max()) / scale


def smallest_eigenvalue(P: Floats) -> float:
    """Smallest eigenvalue of the symmetric part, relative to the largest entry."""
    scale = max(float(np.abs(P).max()), 1e-12)
    return float(np.linalg.eigvalsh((P + P.T) / 2).min()) / scale
