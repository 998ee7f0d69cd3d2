"""Maximum likelihood for the four-state model: EM from several starting points, then a quasi-Newton search.

In each fate the chain can be in two states only, so that it is a row of two-state moves, one kind for each pair of
successive fates. Its coordinates within (0, 1) are: the probability that the good state is left, the share of isolated
losses in that; the probability that a loss in a burst is not followed by another, the share of pauses in that; and
``from_pause``. Where it has no isolated losses the good state and the pauses can change names; then those are called
pauses that end sooner.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from scipy.special import chdtri, expit, logit

from testbed.analysis.fit_chains import chain_log_likelihood, fit_markov
from testbed.analysis.fit_search import Certainty, Coordinates, Found, at_boundary, climbed
from testbed.analysis.fit_states import Blocks, Expected
from testbed.channel.four_state import BURST, GOOD, ISOLATED, PAUSE, four_state
from testbed.channel.hidden import HiddenChain
from testbed.channel.loss import Chain
from testbed.numerics.lanes import Bools, Floats

NAMES = ("to_burst", "to_good", "to_pause", "from_pause", "to_isolated")
_PLACES = ((GOOD, BURST), (BURST, GOOD), (BURST, PAUSE), (PAUSE, BURST), (GOOD, ISOLATED))
EM_STEPS = 8
_BEST = 3  # starting points that are followed to the end
_HALVINGS = 20
_MARKOV = float(chdtri(3, 0.05))  # gain in 2 log of the likelihood by three parameters that says nothing
_NONE = (None,) * len(NAMES)
_PAIRS = np.array([[BURST, ISOLATED], [GOOD, PAUSE]])
"""The states of a fate, lost and arrived."""


class Fates:
    """The fates (n,), n > 1, True where a packet arrived, as a four-state chain gives them, stationary at the first."""

    def __init__(self, fates: Bools) -> None:
        kinds = fates.astype(np.intp)
        self._blocks, self._first = Blocks(2 * kinds[:-1] + kinds[1:], 4), _PAIRS[kinds[0]]

    def expected(self, losses: HiddenChain) -> Expected:
        """moves (1, 4, 4) and first (4,) of the four states."""
        found = self._blocks.expected(losses.initial[self._first], _matrices(losses))
        moves, first = np.zeros((1, 4, 4)), np.zeros(4)
        for symbol, counts in enumerate(found.moves):
            moves[0][np.ix_(*_PAIRS[[symbol // 2, symbol % 2]])] = counts
        first[self._first] = found.first
        return Expected(found.log_likelihood, moves, first)

    def log_likelihood(self, losses: HiddenChain) -> float:
        """log P(fates)."""
        return self._blocks.log_likelihood(losses.initial[self._first], _matrices(losses))


def _matrices(losses: HiddenChain) -> Floats:
    """The moves from the states of a fate to those of the next one, for each pair of fates: 00, 01, 10, 11."""
    return np.array([losses.transition[np.ix_(before, after)] for before in _PAIRS for after in _PAIRS])


def fit_four_state(fates: Bools) -> Found[HiddenChain]:
    """Of all four-state models; fates: (n,), True where a packet arrived, both kinds among them."""
    seen, chain = Fates(fates), fit_markov(fates)
    begun = []
    for losses in starting_points(chain):
        *_, (losses, reached) = em(seen, losses, EM_STEPS)
        begun.append((reached, losses))
    begun.sort(key=lambda pair: pair[0], reverse=True)
    simple = four_state(chain.failure, chain.recovery)
    ends = [simple, *(climbed(seen, _BY, losses) for _, losses in begun[:_BEST])]
    losses = _named(at_boundary(seen, _BY, max(ends, key=seen.log_likelihood), _ENDS))
    reached = seen.log_likelihood(losses)
    if 2.0 * (reached - chain_log_likelihood(fates, chain)) < _MARKOV:
        return Found(losses, reached, _NONE, None, "not identifiable: hardly likelier than a Markov chain")
    return _with_intervals(seen, losses)


def parameters(losses: HiddenChain) -> Floats:
    """(5,), in the order of NAMES."""
    return np.array([losses.moves[before][after] for before, after in _PLACES])


def starting_points(chain: Chain) -> Iterator[HiddenChain]:
    """Models near the Markov chain of the trace, and others with more isolated losses and longer pauses."""
    leave_good, leave_burst = (float(np.clip(rate, 1e-4, 0.95)) for rate in (chain.failure, chain.recovery))
    for isolated in (0.05, 0.5, 0.9):
        burst = leave_burst * (1.0 - 0.7 * isolated)
        for pause, from_pause in ((0.05, 0.5), (0.5, 0.5), (0.8, 0.2)):
            yield _model(np.array([leave_good, isolated, burst, pause, max(from_pause, min(0.95, 2.0 * leave_good))]))


def em(seen: Fates, losses: HiddenChain, steps: int) -> Iterator[tuple[HiddenChain, float]]:
    """Up to ``steps`` + 1 models, each with its log-likelihood, which never falls.

    The M step takes the shares of the moves and leaves the law of the first packet alone. Where that costs more than
    the step gains, the step is halved; where nothing is gained, it ends.
    """
    expected = seen.expected(losses)
    yield losses, expected.log_likelihood
    for _ in range(steps):
        target, values = _shares(losses, expected), _values(losses)
        for halvings in range(_HALVINGS):
            step = _model(_between(values, target, 0.5**halvings))
            with np.errstate(all="ignore"):  # the likelihood of what cannot begin so is no number
                gained = seen.expected(step)
            if gained.log_likelihood >= expected.log_likelihood:
                break
        else:
            return
        losses, expected = step, gained
        yield losses, expected.log_likelihood


def _shares(losses: HiddenChain, expected: Expected) -> Floats:
    """The coordinates that the counts ask for; those of which nothing is told stay."""
    yes, no = _counts(expected)
    met = yes + no
    return np.where(met > 0.0, yes / np.where(met > 0.0, met, 1.0), _values(losses))


def _between(start: Floats, end: Floats, share: float) -> Floats:
    """From start towards end in the logits; share 1: the end itself."""
    if share == 1.0:
        return end
    low, high = 1e-12, 1.0 - 1e-12
    here, there = (logit(np.clip(values, low, high)) for values in (start, end))
    return np.asarray(expit(here + share * (there - here)))


def _counts(expected: Expected) -> tuple[Floats, Floats]:
    """How often what each coordinate is the probability of came true, and how often it did not."""
    n = expected.moves.sum(axis=0)
    pairs = (
        (n[GOOD, BURST] + n[GOOD, ISOLATED], n[GOOD, GOOD]),
        (n[GOOD, ISOLATED], n[GOOD, BURST]),
        (n[BURST, GOOD] + n[BURST, PAUSE], n[BURST, BURST]),
        (n[BURST, PAUSE], n[BURST, GOOD]),
        (n[PAUSE, BURST], n[PAUSE, PAUSE]),
    )
    yes, no = np.array(pairs).T
    return yes, no


def score(losses: HiddenChain, expected: Expected) -> Floats:
    """(5,): the gradient of the log-likelihood in the logits of the coordinates.

    The stationary law is proportional to (1, p13 p32 / (p31 p23), p13 / p31, p14), with the names of netem.
    """
    leave, isolated, ends, pause, resumes = values = _values(losses)
    yes, no = _counts(expected)
    slopes = np.zeros((4, 5))
    slopes[PAUSE] = 1.0 - leave, -isolated, 0.0, 1.0, resumes - 1.0
    slopes[BURST] = 1.0 - leave, -isolated, ends - 1.0, pause, 0.0
    slopes[ISOLATED] = 1.0 - leave, 1.0 - isolated, 0.0, 0.0, 0.0
    return np.asarray(yes - (yes + no) * values + (expected.first - losses.initial) @ slopes)


def _model(values: Floats) -> HiddenChain:
    leave, isolated, ends, pause, resumes = (float(value) for value in values)
    return four_state(leave * (1.0 - isolated), ends * (1.0 - pause), ends * pause, resumes, leave * isolated)


def _values(losses: HiddenChain) -> Floats:
    """(5,): the coordinates; a share of nothing is 0."""
    to_burst, to_good, to_pause, from_pause, to_isolated = parameters(losses)
    leave, ends = to_burst + to_isolated, to_good + to_pause
    return np.array([leave, to_isolated / leave if leave else 0.0, ends, to_pause / ends if ends else 0.0, from_pause])


_BY = Coordinates(_model, _values, score)
_ENDS = ((1, 0.0), (3, 0.0), (2, 1.0), (4, 1.0), (0, 1.0), (1, 1.0))


def _named(losses: HiddenChain) -> HiddenChain:
    """The same model with the names that this file gives its states."""
    to_burst, to_good, to_pause, from_pause, to_isolated = (float(value) for value in parameters(losses))
    if to_isolated == 0.0 and to_pause > 0.0 and from_pause < to_burst:
        return four_state(from_pause, to_pause, to_good, to_burst)
    return losses if to_pause > 0.0 else four_state(to_burst, to_good, to_isolated=to_isolated)


def _with_intervals(seen: Fates, losses: HiddenChain) -> Found[HiddenChain]:
    """Wald's in the logits of the parameters within (0, 1), the coordinates at 0 and 1 held."""
    reached, found = seen.log_likelihood(losses), Certainty.of(seen, _BY, losses)
    if found.covariance is None and found.free.size:
        return Found(losses, reached, _NONE, None, "not identifiable: the information is singular")
    intervals = [
        found.interval(lambda at, i=before, j=after: at.moves[i][j])  # type: ignore[misc]
        for before, after in _PLACES
    ]
    return Found(losses, reached, tuple(intervals), found.interval(lambda at: 1.0 - at.arrival))
