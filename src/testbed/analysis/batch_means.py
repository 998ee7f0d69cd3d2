"""The mean of one correlated series along time, by batches that are long against its correlation."""

from __future__ import annotations

import math

import numpy as np

from testbed.analysis.differences import Difference, average, paired, t_interval, t_test
from testbed.numerics.lanes import Floats

LENGTHS = 8
"""A batch is at least so many correlation times long."""
BATCHES_MIN = 8
BATCHES_MAX = 64


def batched(a: Floats, b: Floats) -> Difference:
    """The difference of two series (T,) of one stationary lane: Student's t of the means of batches of their pairs.

    No interval where fewer than ``BATCHES_MIN`` batches of ``LENGTHS`` correlation times fit, or a value is missing:
    ``note`` says so.
    """
    left_out = int(np.count_nonzero(~(np.isfinite(a) & np.isfinite(b))))
    steps = len(a)
    if left_out or not steps:
        return Difference(
            "batch means", 0, left_out, None, None, None, note=f"{left_out} of {steps} steps have no figure"
        )
    mean_a, mean_b = average(a), average(b)
    time = correlation_time(a - b)
    batches = min(BATCHES_MAX, int(steps / (LENGTHS * time)))
    if batches < BATCHES_MIN:
        note = f"{steps} steps are too few for an interval: the differences are correlated over {time:.3g} steps"
        return Difference("batch means", batches, 0, mean_a, mean_b, average(a - b), note=note)
    means = [np.array([part.mean() for part in np.array_split(series, batches)]) for series in (a, b)]
    found, difference = paired(*means), average(a - b)
    return Difference(
        "batch means",
        batches,
        0,
        mean_a,
        mean_b,
        difference,
        found.stderr,
        t_interval(difference, found.stderr, batches - 1),
        t_test(difference, found.stderr, batches - 1),
        ratio=mean_a / mean_b if mean_a > 0.0 < mean_b else None,
        note=f"{batches} batches of {steps // batches} steps or one more; correlated over {time:.3g} steps",
    )


def correlation_time(values: Floats) -> float:
    """1 + 2 Σ ρ_j of a series (T,), the steps that are worth one independent step; at least 1.

    The sum ends where the sum of two neighbouring ρ is no longer positive, and they may not grow.
    C. J. Geyer: Practical Markov chain Monte Carlo. Statistical Science 7 (1992) 473–483, section 3.3.
    """
    n = len(values)
    away = values - average(values)
    scale = float(np.max(np.abs(away)))
    if n < 4 or scale == 0.0:
        return 1.0
    size = 1 << (2 * n - 1).bit_length()
    spectrum = np.abs(np.fft.rfft(away / scale, size)) ** 2
    covariance = np.fft.irfft(spectrum, size)[: n - n % 2]
    pairs = (covariance[::2] + covariance[1::2]) / covariance[0]
    stop = int(np.argmax(pairs <= 0.0)) if np.any(pairs <= 0.0) else len(pairs)
    time = 2.0 * math.fsum(np.minimum.accumulate(pairs[:stop])) - 1.0
    return max(1.0, time)
