"""Search for the loss model of largest likelihood in coordinates within (0, 1), and how certain they are there.

The gradient comes from the E step (Fisher's identity), and the information from differences of the gradient.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Generic, Protocol, TypeVar

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize
from scipy.special import expit, logit

from testbed.analysis.fit_intervals import Interval, around
from testbed.analysis.fit_states import Expected
from testbed.channel.hidden import Hidden
from testbed.numerics.lanes import Floats

T = TypeVar("T")
M = TypeVar("M", contravariant=True)
H = TypeVar("H", bound=Hidden, covariant=True)
_LOGIT_MAX = 14.0
_SAME = 1e-6  # of the log-likelihood: what a coordinate at 0 or 1 may cost
_NEAR = 0.01
_STEP = 1e-4  # in the logits
_SINGULAR = 1e-4  # least eigenvalue of the information, scaled to ones on its diagonal


@dataclass(frozen=True)
class Found(Generic[H]):
    """The model of largest likelihood, with 95 % intervals of its parameters and of its stationary loss.

    Those of parameters at 0 and 1 are None, and the others are for these held there. Where the parameters cannot be
    told from the fates, ``obstacle`` says why, and there are no intervals at all.
    """

    losses: H
    log_likelihood: float
    intervals: tuple[Interval | None, ...]
    loss_interval: Interval | None
    obstacle: str = ""


class Seen(Protocol[M]):
    """Fates, and what they tell of a model."""

    def expected(self, losses: M) -> Expected: ...

    def log_likelihood(self, losses: M) -> float: ...


@dataclass(frozen=True)
class Coordinates(Generic[T]):
    """of: the model with these values (d,); values: those of a model; score: see there, (d,)."""

    of: Callable[[Floats], T]
    values: Callable[[T], Floats]
    score: Callable[[T, Expected], Floats]
    """The slope of log P(fates) in the logits of the values, from the counts of the E step at a model."""


def climbed(seen: Seen[T], by: Coordinates[T], losses: T) -> T:
    """Where a search in the logits ends."""

    def fallen(logits: np.ndarray[tuple[int], np.dtype[np.float64]]) -> tuple[float, Floats]:
        at = by.of(expit(logits))
        expected = seen.expected(at)
        number = expected.moves.sum()
        return -expected.log_likelihood / number, -by.score(at, expected) / number

    start = np.clip(logit(np.clip(by.values(losses), 1e-9, 1.0 - 1e-9)), -_LOGIT_MAX, _LOGIT_MAX)
    end = minimize(
        fallen,
        start,
        jac=True,
        method="L-BFGS-B",
        bounds=[(-_LOGIT_MAX, _LOGIT_MAX)] * len(start),
        options={"maxiter": 150, "ftol": 1e-15, "gtol": 1e-9},
    )
    return by.of(expit(end.x))


def at_boundary(seen: Seen[T], by: Coordinates[T], losses: T, ends: Sequence[tuple[int, float]]) -> T:
    """With coordinates at exactly 0 or 1 where that costs nothing; ends: (coordinate, 0 or 1), to be tried in turn."""
    reached = seen.log_likelihood(losses)
    for index, value in ends:
        moved = by.values(losses)
        if moved[index] == value or abs(moved[index] - value) > _NEAR:
            continue
        moved[index] = value
        candidate = by.of(moved)
        with np.errstate(all="ignore"):  # what cannot have given these fates has no number
            if seen.log_likelihood(candidate) >= reached - _SAME:
                losses = candidate
    return losses


@dataclass(frozen=True, eq=False)
class Certainty(Generic[T]):
    """The observed information at a model, in the logits of its coordinates ``free`` within (0, 1), the others held.

    covariance: its inverse; None where it is singular.
    """

    by: Coordinates[T]
    losses: T
    free: NDArray[np.intp]
    covariance: Floats | None

    @classmethod
    def of(cls, seen: Seen[T], by: Coordinates[T], losses: T, held: Sequence[int] = ()) -> Certainty[T]:
        """``held``: coordinates that mean nothing here, or are not wanted."""
        values = by.values(losses)
        free = np.flatnonzero((values > 0.0) & (values < 1.0))
        free = free[~np.isin(free, held)]
        if not free.size:
            return cls(by, losses, free, None)
        curvature = _differences(lambda at: by.score(at, seen.expected(at))[free], by, losses, free)
        return cls(by, losses, free, _inverse(-0.5 * (curvature + curvature.T)))

    def interval(self, figure: Callable[[T], float]) -> Interval | None:
        """Wald's, 95 %, in the logit of a figure of the model within (0, 1); None where there is none."""
        value = figure(self.losses)
        if self.covariance is None or not 0.0 < value < 1.0:
            return None
        slope = _differences(lambda at: np.array([logit(figure(at))]), self.by, self.losses, self.free)[:, 0]
        variance = float(slope @ self.covariance @ slope)
        return around(value, float(np.sqrt(variance))) if variance > 0.0 else None


def _differences(function: Callable[[T], Floats], by: Coordinates[T], losses: T, free: NDArray[np.intp]) -> Floats:
    """(free, outputs): central differences of a function of the model in the logits of its free coordinates."""
    rows, values = [], by.values(losses)
    for index in free:
        ends = []
        for step in (_STEP, -_STEP):
            moved = values.copy()
            moved[index] = expit(logit(values[index]) + step)
            ends.append(function(by.of(moved)))
        rows.append((ends[0] - ends[1]) / (2.0 * _STEP))
    return np.array(rows)


def _inverse(information: Floats) -> Floats | None:
    """None where the matrix is not clearly positive definite."""
    diagonal = np.diag(information)
    if not np.all(diagonal > 0.0):
        return None
    scale = 1.0 / np.sqrt(diagonal)
    scaled = information * np.outer(scale, scale)
    if np.linalg.eigvalsh(scaled)[0] < _SINGULAR:
        return None
    return np.asarray(np.linalg.inv(scaled) * np.outer(scale, scale), dtype=np.float64)
