"""Finite Markov chains: which states are reached, and how the time is shared among them in the long run."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from testbed.numerics.lanes import Floats


def reached(begin: NDArray[np.bool_], transition: Floats) -> NDArray[np.bool_]:
    """The states (H,) that may ever be visited from those where ``begin`` (H,) is set; transition (H, H)."""
    found = np.array(begin, dtype=np.bool_)
    while True:
        more = found | (transition[found] > 0.0).any(axis=0)
        if np.array_equal(more, found):
            return found
        found = more


def long_run(initial: Floats, transition: Floats) -> Floats:
    """The shares of the states (H,) over many steps, from initial (H,) and transition (H, H).

    That is the stationary law, zero on what is left for good. Raises ValueError where it depends on chance: where two
    sets of states may be reached that are never left.
    """
    start = reached(initial > 0.0, transition)
    states = np.flatnonzero(start)
    follow = np.array([reached(np.arange(len(initial)) == h, transition) for h in states])
    recurrent = [h for row, h in zip(follow, states, strict=True) if follow[:, h][row[states]].all()]
    closed = follow[np.searchsorted(states, recurrent[0])]
    if not all(closed[h] for h in recurrent):
        raise ValueError("two sets of states are never left")
    inside = np.flatnonzero(closed)
    law = np.zeros(len(initial))
    law[inside] = _eliminated(transition[np.ix_(inside, inside)])
    return law


def _eliminated(transition: Floats) -> Floats:
    """The stationary law of an irreducible chain, each entry to rounding: no subtraction.

    W. K. Grassmann, M. I. Taksar, D. P. Heyman: Regenerative analysis and steady state distributions for Markov chains.
    Oper. Res. 33 (1985) 1107–1116.
    """
    rates = np.array(transition, dtype=np.float64)
    for last in range(len(rates) - 1, 0, -1):
        rates[:last, last] /= rates[last, :last].sum()
        rates[:last, :last] += np.outer(rates[:last, last], rates[last, :last])
    law = np.ones(len(rates))
    for h in range(1, len(rates)):
        law[h] = law[:h] @ rates[:h, h]
    return np.asarray(law / law.sum())


def mixing_sums(transition: Floats, law: Floats, steps: int) -> tuple[Floats, Floats]:
    """Σ_{j=0}^{n−1} D^j and Σ_{j=1}^{n−1} (n − j) D^j, n = steps, D = transition − 1 law: what is left of the start.

    law (H,) is the stationary one and the only one, so that I − D can be inverted.
    """
    D = transition - law
    sums = np.linalg.inv(np.eye(len(law)) - D)
    plain = sums @ (np.eye(len(law)) - np.linalg.matrix_power(D, steps))
    return np.asarray(plain), np.asarray(D @ sums @ (steps * np.eye(len(law)) - plain))


_AT_ONCE = 64
_DOUBLINGS = 60
_FORGOTTEN = 1e-18


def summed_ranges(transition: Floats, law: Floats, values: Floats) -> float | None:
    """A bound of Σ_{j≥1} (max − min of T^j values), T = transition (H, H), values (H,); None where none is found.

    Exactly for the first terms; then the sum of the next 2^i terms is at most that of all before times τ(T^j), by
    Dobrushin's coefficient τ: max − min of T^j v is at most τ(T^j) (max − min of v). law (H,) is the stationary one; of
    two states the bound is exact.
    """
    left = transition - law  # its powers tell rows apart as those of T do, and they vanish
    exact = 1 if len(values) == 2 else _AT_ONCE
    total, ahead = 0.0, values
    for _ in range(exact):
        ahead = left @ ahead
        total += float(np.ptp(ahead))
    power = np.linalg.matrix_power(left, exact)
    for _ in range(_DOUBLINGS):
        kept = 0.5 * float(np.abs(power[:, None] - power[None, :]).sum(axis=2).max())
        if kept < _FORGOTTEN or total == 0.0:
            return total
        total *= 1.0 + kept
        power = power @ power
    return None
