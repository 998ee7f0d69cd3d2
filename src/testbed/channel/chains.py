"""From the scenario's words for a loss to its model."""

from __future__ import annotations

from testbed.channel.gilbert_elliott import GilbertElliott
from testbed.channel.law import LossModel
from testbed.channel.loss import Chain
from testbed.scenario import BernoulliLoss, GilbertElliottLoss, Loss, NoLoss


def chain_of(loss: Loss) -> LossModel:
    """The chain of arrivals of a loss, or the hidden chain behind it."""
    if isinstance(loss, NoLoss):
        return Chain.lossless()
    if isinstance(loss, BernoulliLoss):
        return Chain.bernoulli(loss.arrival)
    if isinstance(loss, GilbertElliottLoss):
        return GilbertElliott.of(loss.to_bad, loss.to_good, loss.loss_good, loss.loss_bad, loss.start_good)
    return Chain.markov(loss.recovery, loss.failure, loss.start)
