"""Figures that the report and the closing table derive from a summary; no other place computes them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from testbed.orchestrator.lane_windows import first_settled
from testbed.orchestrator.summary import Z_95, EstimatorFigures, Series, Summary

Vector = NDArray[np.float64]


@dataclass(frozen=True)
class Settled:
    """One estimator over the last quarter of the steps that it ran: k = first … last, at least one step.

    A mean is None when a step of the quarter has no figure: a value that overflowed must not drop out of its mean.
    A standard error is the mean of those of the steps: an upper bound, reached when the steps of a lane are fully
    correlated. The shares are over all the steps that it ran and None when no step has the figure.
    """

    first: int
    last: int
    trace_P: float | None
    trace_P_stderr: float | None
    squared_error: float | None
    squared_error_stderr: float | None
    nees: float | None
    nees_in_band: float | None
    excess_consistent: float | None
    missing: int
    """Steps that it should have run and whose tr P does not exist."""


def as_vector(series: Series) -> Vector:
    """`series` along k, with not-a-number for null."""
    return np.array([np.nan if value is None else value for value in series], dtype=np.float64)


def steps_run(figures: EstimatorFigures, completed_steps: int) -> int:
    """The last step that the estimator ran; 0 if none."""
    return completed_steps if figures.until is None else min(figures.until, completed_steps)


def settled(figures: EstimatorFigures, completed_steps: int) -> Settled | None:
    """The last quarter of the steps that the estimator ran; None if it ran none."""
    last = steps_run(figures, completed_steps)
    if last < figures.since:
        return None
    first = figures.since - 1 + first_settled(last - figures.since + 1)

    def quarter(series: Series) -> float | None:
        return mean(as_vector(series)[first - 1 : last])

    return Settled(
        first=first,
        last=last,
        trace_P=quarter(figures.trace_P_mean),
        trace_P_stderr=quarter(figures.trace_P_stderr),
        squared_error=quarter(figures.squared_error_mean),
        squared_error_stderr=quarter(figures.squared_error_stderr),
        nees=quarter(figures.nees_mean),
        nees_in_band=_share(nees_in_band(figures)),
        excess_consistent=_share(excess_consistent(figures)),
        missing=sum(value is None for value in figures.trace_P_mean[figures.since - 1 : last]),
    )


def mean(values: Vector) -> float | None:
    """The mean, also of values whose sum overflows; None if one does not exist."""
    scale = float(np.max(np.abs(values), initial=0.0))
    if values.size == 0 or not np.isfinite(scale):
        return None
    return scale * float(np.mean(values / scale)) if scale > 0 else 0.0


def nees_in_band(figures: EstimatorFigures) -> Vector:
    """1 where the mean NEES is in its 95 % band, 0 where it is not, not-a-number where there is none."""
    low, high = figures.nees_band_95
    nees = as_vector(figures.nees_mean)
    return np.where(np.isnan(nees), np.nan, (nees >= low) & (nees <= high))


def excess_consistent(figures: EstimatorFigures) -> Vector:
    """1 where |excess| < 1.96 standard errors, 0 where it is not, not-a-number where there is no standard error."""
    excess, stderr = as_vector(figures.excess_mean), as_vector(figures.excess_stderr)
    return np.where(np.isnan(excess) | np.isnan(stderr), np.nan, np.abs(excess) < Z_95 * stderr)


def relative_excess(figures: EstimatorFigures) -> tuple[Vector, Vector]:
    """Excess and its standard error, both divided by mean tr P; not-a-number where tr P is zero."""
    trace = as_vector(figures.trace_P_mean)
    trace[trace <= 0] = np.nan
    with np.errstate(over="ignore"):
        return as_vector(figures.excess_mean) / trace, as_vector(figures.excess_stderr) / trace


def common_band(summary: Summary) -> tuple[float, float] | None:
    """The NEES band when all estimators share one; None if they do not, or there is no estimator."""
    bands = {figures.nees_band_95 for figures in summary.estimators.values()}
    return bands.pop() if len(bands) == 1 else None


def _share(marks: Vector) -> float | None:
    known = marks[~np.isnan(marks)]
    return float(np.mean(known)) if known.size else None
