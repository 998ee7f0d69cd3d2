"""What the hypotheses of GPB know of the fate of the next control packet.

Components are arrays of shape (H · M,), the M lanes of hypothesis 0 first, as in GPB.
"""

from __future__ import annotations

from typing import Protocol

import numpy as np

from testbed.channel.law import Law
from testbed.estimator.mixtures import IMPOSSIBLE, score_of, share, start_scores, transition_scores
from testbed.estimator.state import Given, State, last_law
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

    def state(self) -> State:
        """What is known besides the bits that are told apart."""
        ...

    def set_state(self, given: Given, bits: int, lanes: int) -> None:
        """Back to a ``state`` in which so many bits were told apart."""
        ...

    def start_from(self, step: int, lanes: int) -> None:
        """After ``step`` steps of which nothing is known, and with no bit told apart."""
        ...


def fates_of(law: Law) -> Fates:
    return Visible(law) if law.visible else Hidden(law)


class Visible:
    """The newest bit says all. Where that is merged too, its posterior is kept apart, as scores."""

    def __init__(self, law: Law) -> None:
        self._law, self._start, self._rows = law, start_scores(law), transition_scores(law)
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
        self._first, self._posterior = False, None

    def merge(self, even: Floats, odd: Floats, lanes: int) -> None:
        if len(even) == lanes:
            self._posterior = even, odd

    def state(self) -> State:
        """Scores of the last ν where no bit is told apart."""
        if self._posterior is None:
            return {}
        return {name: np.array(score) for name, score in zip(("lost", "delivered"), self._posterior, strict=True)}

    def set_state(self, given: Given, bits: int, lanes: int) -> None:
        self._first, self._posterior = not given.step, None
        if given.step and not bits:
            self._posterior = given.array("lost", np.float64, lanes), given.array("delivered", np.float64, lanes)

    def start_from(self, step: int, lanes: int) -> None:
        self._first, self._posterior = not step, None
        if step:
            lost, delivered = (np.full(lanes, score_of(w)) for w in last_law(self._law, step))
            self._posterior = lost, delivered


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

    def state(self) -> State:
        """P(h | hypothesis), (states, 2^bits · M), from the first step on."""
        return {} if self._states is None else {"states": np.array(self._states)}

    def set_state(self, given: Given, bits: int, lanes: int) -> None:
        size = len(self._law.arrived), lanes * 2**bits
        self._states = given.array("states", np.float64, *size) if given.step else None

    def start_from(self, step: int, lanes: int) -> None:
        self._states = np.repeat(last_law(self._law, step)[:, None], lanes, axis=1) if step else None
