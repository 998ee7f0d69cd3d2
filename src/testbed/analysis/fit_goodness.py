"""Whether runs of equal fates are as long as a loss model says: Pearson's χ² of their histograms."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.special import chdtrc

from testbed.analysis.bursts import PhaseType, run_law
from testbed.channel.law import LossModel
from testbed.numerics.lanes import Bools

_EXPECTED_MIN = 5.0


@dataclass(frozen=True)
class Histogram:
    """Runs of one fate, and the χ² of their lengths in cells; ``observed`` beside ``expected``, runs a cell.

    upto: the last length of each cell; None: no end.
    """

    runs: int
    chi2: float
    upto: list[int | None]
    observed: list[int]
    expected: list[float]


@dataclass(frozen=True)
class Goodness:
    """Bursts of losses and gaps between them, and the test of both; p_value None where no degree of freedom is left."""

    bursts: Histogram
    gaps: Histogram
    chi2: float
    degrees: int
    p_value: float | None


def goodness(fates: Bools, losses: LossModel, fitted: int) -> Goodness:
    """The test of a model with ``fitted`` parameters that come from these fates.

    One test of both histograms: the parameters take their degrees of freedom from the two together. The first and the
    last run are cut off, so they do not count.
    """
    bursts, gaps = (_histogram(runs(fates, fate), run_law(losses, fate)) for fate in (False, True))
    chi2 = bursts.chi2 + gaps.chi2
    degrees = max(0, len(bursts.upto) - 1) + max(0, len(gaps.upto) - 1) - fitted
    return Goodness(bursts, gaps, chi2, max(0, degrees), float(chdtrc(degrees, chi2)) if degrees > 0 else None)


def runs(fates: Bools, fate: bool) -> NDArray[np.intp]:
    """Lengths of the whole runs of a fate, those that begin and end within the trace."""
    ends = np.flatnonzero(np.diff(fates.astype(np.int8))) + 1
    kinds = fates[ends[:-1]]
    lengths: NDArray[np.intp] = np.diff(ends)[kinds == fate]
    return lengths


def _histogram(lengths: NDArray[np.intp], law: PhaseType | None) -> Histogram:
    """In cells of about the same number of expected runs, 5 or more, and about 2 n^{2/5} of them.

    H. B. Mann, A. Wald: On the choice of the number of class intervals. Ann. Math. Statist. 13 (1942) 306–317.
    """
    number = len(lengths)
    if law is None or number == 0:
        return Histogram(number, 0.0, [], [], [])
    share = max(_EXPECTED_MIN / number, 1.0 / math.ceil(2.0 * number**0.4))
    edges, tails = [0], [1.0]
    while tails[-1] >= 2.0 * share:
        edge = law.quantile(1.0 - (tails[-1] - share))
        tail = law.tail(edge)
        if tail < share:
            break
        edges.append(edge)
        tails.append(tail)
    expected = number * -np.diff([*tails, 0.0])
    observed = np.bincount(np.searchsorted(edges, lengths, side="left") - 1, minlength=len(edges))
    chi2 = float(((observed - expected) ** 2 / expected).sum())
    return Histogram(number, chi2, [*edges[1:], None], observed.tolist(), expected.tolist())
