"""Maximum likelihood for the Gilbert–Elliott channel: EM from several starting points, then a quasi-Newton search.

The gradient comes from the E step too (Fisher's identity), and the information from differences of the gradient.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize
from scipy.special import chdtri, expit, logit

from testbed.analysis.fit_chains import chain_log_likelihood, fit_bernoulli, fit_markov, stationary_rates
from testbed.analysis.fit_intervals import Interval, around
from testbed.analysis.fit_states import Expected, Fates
from testbed.channel.gilbert_elliott import GilbertElliott
from testbed.numerics.lanes import Bools, Floats

NAMES = ("to_bad", "to_good", "loss_good", "loss_bad")
EM_STEPS = 8
_BEST = 3  # starting points that are followed to the end
_LOGIT_MAX = 14.0
_SAME = 1e-6  # of the log-likelihood: what a parameter at 0 or 1 may cost
_INDEPENDENT = float(chdtri(3, 0.05))  # gain in 2 log of the likelihood by three parameters that says nothing
_NONE = (None,) * len(NAMES)
_STEP = 1e-4  # in the logits
_SINGULAR = 1e-4  # least eigenvalue of the information, scaled to ones on its diagonal


@dataclass(frozen=True)
class Found:
    """The channel of largest likelihood. ``intervals`` of NAMES and of the stationary loss.

    Those of parameters at 0 and 1 are None, and the others are for these held there. Where the parameters cannot be
    told from the fates, ``obstacle`` says why, and there are no intervals at all.
    """

    losses: GilbertElliott
    log_likelihood: float
    intervals: tuple[Interval | None, ...]
    loss_interval: Interval | None
    obstacle: str = ""


def fit_gilbert_elliott(fates: Bools) -> Found:
    """Of all channels with loss_good ≤ loss_bad; fates: (n,), True where a packet arrived, both kinds among them."""
    seen = Fates(fates)
    begun = []
    for losses in starting_points(fates):
        *_, (losses, reached) = em(seen, losses, EM_STEPS)
        begun.append((reached, losses))
    begun.sort(key=lambda pair: pair[0], reverse=True)
    chain = fit_markov(fates)
    simple = GilbertElliott(chain, 0.0, 1.0)
    ends = [simple, *(_climbed(seen, losses) for _, losses in begun[:_BEST])]
    losses = _at_the_boundary(seen, _ordered(max(ends, key=seen.log_likelihood)))
    reached = seen.log_likelihood(losses)
    if 2.0 * (reached - chain_log_likelihood(fates, fit_bernoulli(fates))) < _INDEPENDENT:
        return Found(losses, reached, _NONE, None, "not identifiable: hardly likelier than independent losses")
    return _with_intervals(seen, losses)


def starting_points(fates: Bools) -> Iterator[GilbertElliott]:
    """Channels with the loss rate of the trace: one near its Markov chain, the others of longer and shorter memory."""
    loss, chain = 1.0 - float(np.mean(fates)), fit_markov(fates)
    low, high = 1e-3, 1.0 - 1e-3
    yield _channel(np.clip([chain.failure, chain.recovery, 0.05 * loss, 0.95], low * loss, high))
    for memory in (0.5, 0.9, 0.98):
        for bad in (0.1, 0.4):
            loss_bad = min(high, loss / bad * (0.5 + 0.5 * bad))
            rest = max((loss - bad * loss_bad) / (1.0 - bad), low * loss)
            yield GilbertElliott.of((1.0 - memory) * bad, (1.0 - memory) * (1.0 - bad), rest, loss_bad)


def em(seen: Fates, losses: GilbertElliott, steps: int) -> Iterator[tuple[GilbertElliott, float]]:
    """``steps`` + 1 channels, each with its log-likelihood, which never falls."""
    for _ in range(steps):
        expected = seen.expected(losses)
        yield losses, expected.log_likelihood
        losses = _improved(losses, expected)
    yield losses, seen.log_likelihood(losses)


def _improved(losses: GilbertElliott, expected: Expected) -> GilbertElliott:
    """The M step; a state that no packet met keeps its loss."""
    moves = losses.states.recovery + losses.states.failure
    to_bad, to_good = stationary_rates(expected.moves.sum(axis=0), expected.first, moves)
    (lost_bad, lost_good), (met_bad, met_good) = expected.moves[0].sum(axis=1), expected.moves.sum(axis=(0, 2))
    return GilbertElliott.of(
        to_bad,
        to_good,
        min(1.0, float(lost_good / met_good)) if met_good > 0.0 else losses.loss_good,
        min(1.0, float(lost_bad / met_bad)) if met_bad > 0.0 else losses.loss_bad,
    )


def parameters(losses: GilbertElliott) -> Floats:
    """(4,), in the order of NAMES."""
    return np.array([losses.states.failure, losses.states.recovery, losses.loss_good, losses.loss_bad])


def _channel(values: Floats) -> GilbertElliott:
    """The stationary channel of these parameters, (4,)."""
    to_bad, to_good, loss_good, loss_bad = (float(value) for value in values)
    return GilbertElliott.of(to_bad, to_good, loss_good, loss_bad)


def score(losses: GilbertElliott, expected: Expected) -> Floats:
    """(4,): the gradient of the log-likelihood in the logits of the parameters."""
    to_bad, to_good, loss_good, loss_bad = parameters(losses)
    n, first, moves = expected.moves.sum(axis=0), expected.first, to_bad + to_good
    (lost_bad, lost_good), (met_bad, met_good) = expected.moves[0].sum(axis=1), n.sum(axis=1)
    return np.array(
        [
            (n[1, 0] + first[0]) * (1.0 - to_bad) - n[1, 1] * to_bad - to_bad * (1.0 - to_bad) / moves,
            (n[0, 1] + first[1]) * (1.0 - to_good) - n[0, 0] * to_good - to_good * (1.0 - to_good) / moves,
            lost_good - loss_good * met_good,
            lost_bad - loss_bad * met_bad,
        ]
    )


def _climbed(seen: Fates, losses: GilbertElliott) -> GilbertElliott:
    """Where a search in the logits ends."""

    def fallen(logits: np.ndarray[tuple[int], np.dtype[np.float64]]) -> tuple[float, Floats]:
        at = _channel(expit(logits))
        expected = seen.expected(at)
        number = expected.moves.sum()
        return -expected.log_likelihood / number, -score(at, expected) / number

    start = np.clip(logit(np.clip(parameters(losses), 1e-9, 1.0 - 1e-9)), -_LOGIT_MAX, _LOGIT_MAX)
    end = minimize(
        fallen,
        start,
        jac=True,
        method="L-BFGS-B",
        bounds=[(-_LOGIT_MAX, _LOGIT_MAX)] * 4,
        options={"maxiter": 150, "ftol": 1e-15, "gtol": 1e-9},
    )
    return _channel(expit(end.x))


def _ordered(losses: GilbertElliott) -> GilbertElliott:
    """The same channel with the names of its states such that the bad one loses more."""
    if losses.loss_good <= losses.loss_bad:
        return losses
    states = losses.states
    return GilbertElliott.of(states.recovery, states.failure, losses.loss_bad, losses.loss_good)


def _at_the_boundary(seen: Fates, losses: GilbertElliott) -> GilbertElliott:
    """With parameters at exactly 0 or 1 where that costs nothing."""
    reached = seen.log_likelihood(losses)
    for index, value in ((2, 0.0), (3, 1.0), (0, 1.0), (1, 1.0)):
        moved = parameters(losses)
        if moved[index] == value or abs(moved[index] - value) > 0.01:
            continue
        moved[index] = value
        candidate = _channel(moved)
        if seen.log_likelihood(candidate) >= reached - _SAME:
            losses = candidate
    return losses


def _with_intervals(seen: Fates, losses: GilbertElliott) -> Found:
    """Wald's in the logits of the parameters within (0, 1), the others held."""
    reached, values = seen.log_likelihood(losses), parameters(losses)
    free = np.flatnonzero((values > 0.0) & (values < 1.0))
    if not free.size:
        return Found(losses, reached, _NONE, None)
    curvature = _differences(lambda at: score(at, seen.expected(at))[free], values, free)
    covariance = _inverse(-0.5 * (curvature + curvature.T))
    if covariance is None:
        return Found(losses, reached, _NONE, None, "not identifiable: the information is singular")
    intervals: list[Interval | None] = [None] * 4
    for index, variance in zip(free, np.diag(covariance), strict=True):
        intervals[index] = around(float(values[index]), float(np.sqrt(variance)))
    slope = _differences(lambda at: np.array([logit(1.0 - at.arrival)]), values, free)[:, 0]
    loss = around(1.0 - losses.arrival, float(np.sqrt(slope @ covariance @ slope)))
    return Found(losses, reached, tuple(intervals), loss)


def _differences(function: Callable[[GilbertElliott], Floats], values: Floats, free: NDArray[np.intp]) -> Floats:
    """(free, outputs): central differences of a function of the channel in the logits of its free parameters."""
    rows = []
    for index in free:
        ends = []
        for step in (_STEP, -_STEP):
            moved = values.copy()
            moved[index] = expit(logit(values[index]) + step)
            ends.append(function(_channel(moved)))
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
