"""That two runs of estimators over a trial, or a run and a reference, give the same estimates."""

from __future__ import annotations

from estimator.reference.cases import Floats
from estimator.reference.compare import covariance_error, mean_error

Run = tuple[Floats, Floats]


def assert_same(run: Run, reference: Run, tolerance: float) -> None:
    """x̂ (K, M, n) and P (K, M, n, n) of both, at every step and in every lane."""
    assert run[0].shape == reference[0].shape
    assert run[1].shape == reference[1].shape
    for k in range(run[0].shape[0]):
        for lane in range(run[0].shape[1]):
            assert covariance_error(run[1][k, lane], reference[1][k, lane]) < tolerance
            assert mean_error(run[0][k, lane], reference[0][k, lane], reference[1][k, lane]) < tolerance
