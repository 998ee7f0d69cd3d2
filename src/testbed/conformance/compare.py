"""How far two runs are apart, and whether one covariance is below another."""

from __future__ import annotations

import numpy as np

from testbed.numerics.lanes import Floats


def distance(x_hat: Floats, P: Floats, other_x: Floats, other_P: Floats) -> float:
    """The largest error at any step and in any lane, relative to the entries of the others; NaN counts as infinite.

    x̂ (K, M, n), P (K, M, n, n). That of P is relative to its largest entry, that of x̂ to its largest entry or, where
    that is larger, to the largest standard deviation.
    """
    scale_P = np.maximum(np.abs(other_P).max(axis=(2, 3)), 1e-300)
    scale_x = np.maximum(np.abs(other_x).max(axis=2), np.sqrt(scale_P))
    error_P = np.abs(P - other_P).max(axis=(2, 3)) / scale_P
    error_x = np.abs(x_hat - other_x).max(axis=2) / scale_x
    return _largest(np.maximum(error_x, error_P))


def asymmetry(P: Floats) -> float:
    """The largest |P − P'|, relative to the largest entry of that P."""
    scale = np.maximum(np.abs(P).max(axis=(2, 3)), 1e-300)
    return _largest(np.abs(P - P.transpose(0, 1, 3, 2)).max(axis=(2, 3)) / scale)


def smallest_eigenvalue(P: Floats) -> float:
    """That of the symmetric parts, relative to the largest entry of that P; −∞ where P is not finite."""
    if not np.isfinite(P).all():
        return -np.inf
    scale = np.maximum(np.abs(P).max(axis=(2, 3), keepdims=True), 1e-300)
    return float(np.linalg.eigvalsh((P + P.transpose(0, 1, 3, 2)) / (2.0 * scale)).min())


def ratio(P: Floats, lower: Floats) -> float:
    """The largest c with P ≥ c · lower at every step, lower (K, n, n) positive definite; −∞ where P is not finite."""
    if not np.isfinite(P).all():
        return -np.inf
    inverse = np.linalg.inv(np.linalg.cholesky(lower))
    inner = inverse @ ((P + P.transpose(0, 2, 1)) / 2.0) @ inverse.transpose(0, 2, 1)
    return float(np.linalg.eigvalsh(inner).min())


def _largest(errors: Floats) -> float:
    return float(np.where(np.isnan(errors), np.inf, errors).max())
