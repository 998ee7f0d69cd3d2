"""The posterior of one lane as a Gaussian mixture of one common covariance (theory.md 3.2), on a lattice or not.

A component is a pair of a history h of the undecided control packets and a node z of a lattice; its mean is
centre + offset_h + basis z. One node: exact enumeration. All values here are replaced, never changed in place, so that
a posterior may be kept to go back to.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from testbed.channel.law import Law
from testbed.estimator.errors import ContradictoryAck
from testbed.estimator.model import Model
from testbed.numerics.lanes import Floats


@dataclass(frozen=True, eq=False)
class Posterior:
    """centre (n,), basis (n, n), nodes (N, n), offsets (H, n), covariance (n, n).

    undecided: packets whose fates the bits of a history's index are, H = 2^undecided, the newest in the lowest bit.
    weights (S, H, N): share of each hidden state of the control link at the newest packet, as the link's law alone
    and what was known at the last re-expansion give it; scores (H, N): logarithms of the likelihoods since then, up
    to a constant. fresh: the hidden states are those of the next packet, not of the newest.
    """

    step: int
    centre: Floats
    basis: Floats
    nodes: Floats
    offsets: Floats
    undecided: tuple[int, ...]
    weights: Floats
    scores: Floats
    covariance: Floats
    fresh: bool

    @property
    def components(self) -> int:
        return self.scores.size

    def shares(self) -> Floats:
        """Logarithms of the components' weights, (S, H, N), the largest about 0; −inf for the impossible."""
        with np.errstate(divide="ignore"):
            return np.asarray(np.log(self.weights) + self.scores)

    def moments(self) -> tuple[Floats, Floats]:
        """Mean (n,) and covariance (n, n)."""
        prior = self.weights.sum(axis=0)
        weights = prior * np.exp(self.scores - self.scores[prior > 0.0].max())
        weights /= weights.sum()
        away = (self.offsets[:, None, :] + self.nodes @ self.basis.T).reshape(-1, len(self.centre))
        flat = weights.ravel()
        mean = flat @ away
        away -= mean
        left = flat @ away
        away -= left
        spread = (away * flat[:, None]).T @ away
        return self.centre + mean + left, self.covariance + 0.5 * (spread + spread.T)


class Fates:
    """The law of the control link's losses, as mixtures over its hidden states use it.

    A law without memory has one state here, whatever it has elsewhere.
    """

    def __init__(self, law: Law) -> None:
        self._law, self._rate = law, float(law.initial[law.arrived].sum())
        self.states = 1 if law.memoryless else len(law.initial)

    def at(self, packet: int) -> Floats:
        """Law of the hidden state of a packet, (S,)."""
        if self.states == 1:
            return np.ones(1)
        return np.asarray(self._law.initial @ np.linalg.matrix_power(self._law.transition, packet))

    def split(self, weights: Floats, fresh: bool) -> tuple[Floats, Floats]:
        """Weights (S, …) of the newest packet's hidden states → of the next packet's, where it is lost and where not.

        fresh: they are those of the next packet already.
        """
        if self.states == 1:
            return (1.0 - self._rate) * weights, self._rate * weights
        ahead = weights if fresh else np.tensordot(self._law.transition.T, weights, axes=1)
        arrived = self._law.arrived.reshape(-1, *[1] * (weights.ndim - 1))
        return np.where(arrived, 0.0, ahead), np.where(arrived, ahead, 0.0)


def predicted(posterior: Posterior, model: Model, fates: Fates, push: Floats, nu: int | None) -> Posterior:
    """The move of the plant under B u = push; each history splits in two unless ν is known.

    Raises ContradictoryAck where the known ν is impossible.
    """
    packet = posterior.step
    lost, delivered = fates.split(posterior.weights, posterior.fresh)
    moved = posterior.offsets @ model.A.T
    centre = model.A @ posterior.centre
    if nu is None:
        weights = np.stack([lost, delivered], axis=2).reshape(len(lost), -1, lost.shape[2])
        offsets = np.stack([moved - 0.5 * push, moved + 0.5 * push], axis=1).reshape(-1, len(push))
        centre, scores = centre + 0.5 * push, np.repeat(posterior.scores, 2, axis=0)
        undecided = (*posterior.undecided, packet)
    else:
        weights, offsets, scores = (delivered if nu else lost), moved, posterior.scores
        centre, undecided = centre + nu * push, posterior.undecided
    if not weights.any():
        raise ContradictoryAck("an ACK says what the model of the control link holds to be impossible")
    return replace(
        posterior,
        step=packet + 1,
        centre=centre,
        basis=model.A @ posterior.basis,
        offsets=offsets,
        undecided=undecided,
        weights=weights,
        scores=scores,
        covariance=model.A @ posterior.covariance @ model.A.T + model.Q,
        fresh=False,
    )


def updated(posterior: Posterior, model: Model, y: Floats) -> Posterior:
    """Bayes' rule with the observation y (p,)."""
    prior = posterior.covariance
    factor = np.linalg.cholesky(model.C @ prior @ model.C.T + model.R)
    half = np.linalg.inv(factor)
    gain = (half.T @ (half @ (model.C @ prior))).T
    innovation = y - model.C @ posterior.centre
    of_history = (innovation - posterior.offsets @ model.C.T) @ half.T
    of_node = posterior.nodes @ (half @ model.C @ posterior.basis).T
    scores = posterior.scores
    for i in range(len(y)):
        away = of_history[:, i, None] - of_node[None, :, i]
        scores = scores - 0.5 * away * away
    complement = np.eye(len(posterior.centre)) - gain @ model.C
    return replace(
        posterior,
        centre=posterior.centre + gain @ innovation,
        basis=complement @ posterior.basis,
        offsets=posterior.offsets @ complement.T,
        scores=scores - scores.max(),
        covariance=complement @ prior @ complement.T + gain @ model.R @ gain.T,
    )


def decided(posterior: Posterior, fates: Mapping[int, int]) -> Posterior:
    """The histories that agree with the fates of some of the undecided packets.

    Raises ContradictoryAck if there is none.
    """
    fates = {j: nu for j, nu in fates.items() if j in posterior.undecided}
    if not fates:
        return posterior
    count = len(posterior.undecided)
    keep = np.ones(len(posterior.offsets), dtype=np.bool_)
    for j, nu in fates.items():
        bit = count - 1 - posterior.undecided.index(j)
        keep &= (np.arange(len(keep)) >> bit) % 2 == nu
    weights = posterior.weights[:, keep]
    if not weights.any():
        raise ContradictoryAck("an ACK says what the model of the control link holds to be impossible")
    possible = np.where(weights.any(axis=0), posterior.scores[keep], -np.inf)
    return replace(
        posterior,
        offsets=posterior.offsets[keep],
        undecided=tuple(j for j in posterior.undecided if j not in fates),
        weights=weights,
        scores=posterior.scores[keep] - possible.max(),
    )
