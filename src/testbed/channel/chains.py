"""From the scenario's words for a loss to its chain."""

from __future__ import annotations

from testbed.channel.loss import Chain
from testbed.scenario import BernoulliLoss, Loss, NoLoss


def chain_of(loss: Loss) -> Chain:
    """The arrival chain of a loss model."""
    if isinstance(loss, NoLoss):
        return Chain.lossless()
    if isinstance(loss, BernoulliLoss):
        return Chain.bernoulli(loss.arrival)
    return Chain.markov(loss.recovery, loss.failure, loss.start)
