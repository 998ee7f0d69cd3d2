"""Maximum likelihood for the Gilbert–Elliott channel: EM from several starting points, then a quasi-Newton search."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from scipy.special import chdtri

from testbed.analysis.fit_chains import chain_log_likelihood, fit_bernoulli, fit_markov, stationary_rates
from testbed.analysis.fit_intervals import Interval, around
from testbed.analysis.fit_search import Certainty, Coordinates, Found, at_boundary, climbed
from testbed.analysis.fit_states import Expected, Fates
from testbed.channel.gilbert_elliott import GilbertElliott
from testbed.numerics.lanes import Bools, Floats

NAMES = ("to_bad", "to_good", "loss_good", "loss_bad")
EM_STEPS = 8
_BEST = 3  # starting points that are followed to the end
_INDEPENDENT = float(chdtri(3, 0.05))  # gain in 2 log of the likelihood by three parameters that says nothing
_NONE = (None,) * len(NAMES)


def fit_gilbert_elliott(fates: Bools) -> Found[GilbertElliott]:
    """Of all channels with loss_good ≤ loss_bad; fates: (n,), True where a packet arrived, both kinds among them."""
    seen = Fates(fates)
    begun = []
    for losses in starting_points(fates):
        *_, (losses, reached) = em(seen, losses, EM_STEPS)
        begun.append((reached, losses))
    begun.sort(key=lambda pair: pair[0], reverse=True)
    chain = fit_markov(fates)
    simple = GilbertElliott(chain, 0.0, 1.0)
    ends = [simple, *(climbed(seen, _BY, losses) for _, losses in begun[:_BEST])]
    losses = at_boundary(seen, _BY, _ordered(max(ends, key=seen.log_likelihood)), _ENDS)
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


_BY = Coordinates(_channel, parameters, score)
_ENDS = ((2, 0.0), (3, 1.0), (0, 1.0), (1, 1.0))


def _ordered(losses: GilbertElliott) -> GilbertElliott:
    """The same channel with the names of its states such that the bad one loses more."""
    if losses.loss_good <= losses.loss_bad:
        return losses
    states = losses.states
    return GilbertElliott.of(states.recovery, states.failure, losses.loss_bad, losses.loss_good)


def _with_intervals(seen: Fates, losses: GilbertElliott) -> Found[GilbertElliott]:
    """Wald's in the logits of the parameters within (0, 1), the others held."""
    reached, found = seen.log_likelihood(losses), Certainty.of(seen, _BY, losses)
    if not found.free.size:
        return Found(losses, reached, _NONE, None)
    if found.covariance is None:
        return Found(losses, reached, _NONE, None, "not identifiable: the information is singular")
    intervals: list[Interval | None] = [None] * len(NAMES)
    for index, variance in zip(found.free, np.diag(found.covariance), strict=True):
        intervals[index] = around(float(parameters(losses)[index]), float(np.sqrt(variance)))
    return Found(losses, reached, tuple(intervals), found.interval(lambda at: 1.0 - at.arrival))
