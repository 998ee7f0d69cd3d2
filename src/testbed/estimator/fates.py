"""What the hypotheses of GPB know of the fate of the next control packet.

Components are arrays of shape (H · M,), the M lanes of hypothesis 0 first, as in GPB.
"""

from __future__ import annotations

from typing import Protocol

import numpy as np

from testbed.channel.law import Law
from testbed.estimator.mixtures import IMPOSSIBLE, share, start_scores, transition_scores
from testbed.numerics.lanes import Floats


class Fates(Protocol):
    """Told of every branching and merging of the hypotheses, it gives the prior of their next bit."""

    def priors(self, size: int) -> list[Floats]:
        """log P(ν = 0 | hypothesis) and log P(ν = 1 | hypothesis) of the next packet, each (size,)."""
        ...

    def branch(self) -> None:
        """Each hypothesis has split by the bit that ``priors`` was asked for: those with 0 first, then those with 1."""
        ...

    def merge(self, even: Floats, odd: Floats, lanes: int) -> None:
        """The pairs that differ in the oldest bit become one; their scores."""
        ...


def fates_of(law: Law) -> Fates:
    return Visible(law) if law.visible else Hidden(law)


class Visible:
    """The newest bit says all. Where that is merged too, its posterior is kept apart, as scores."""

    def __init__(self, law: Law) -> None:
        self._start, self._rows = start_scores(law), transition_scores(law)
        self._first = True
        self._posterior: tuple[Floats, Floats] | None = None

    def priors(self, size: int) -> list[Floats]:
        if self._first:
            return [np.full(size, score) for score in self._start]
        rows = self._rows
        if self._posterior is not None:
            last = self._posterior
            return [np.asarray(share(last[0] + rows[0][nu], last[1] + rows[1][nu])[2]) for nu in (0, 1)]
        return [np.repeat([rows[0][nu], rows[1][nu]], size // 2) for nu in (0, 1)]

    def branch(self) -> None:
        self._first = False

    def merge(self, even: Floats, odd: Floats, lanes: int) -> None:
        if len(even) == lanes:
            self._posterior = even, odd


class Hidden:
    """Each hypothesis carries the filter of the hidden state: P(h | hypothesis), (states, size)."""

    def __init__(self, law: Law) -> None:
        self._law = law
        self._after: list[Floats] = []
        self._states: Floats | None = None

    def priors(self, size: int) -> list[Floats]:
        law = self._law
        if self._states is None:
            ahead = np.repeat(law.initial[:, None], size, axis=1)
        else:
            ahead = law.transition.T @ self._states
        self._after, priors = [], []
        for fate in (False, True):
            here = np.where((law.arrived == fate)[:, None], ahead, 0.0)
            chance = here.sum(axis=0)
            possible = chance > 0.0
            priors.append(np.log(chance, out=np.full(size, IMPOSSIBLE), where=possible))
            self._after.append(here / np.where(possible, chance, 1.0))
        return priors

    def branch(self) -> None:
        self._states = np.concatenate(self._after, axis=1)

    def merge(self, even: Floats, odd: Floats, lanes: int) -> None:
        assert self._states is not None
        pairs = self._states.reshape(len(self._states), -1, 2, lanes)
        first, second, _ = share(even, odd)
        self._states = pairs[:, :, 0].reshape(len(pairs), -1) * first + pairs[:, :, 1].reshape(len(pairs), -1) * second
