"""From the scenario's words for a loss to its model."""

from __future__ import annotations

from testbed.channel.four_state import four_state
from testbed.channel.gilbert_elliott import GilbertElliott
from testbed.channel.law import LossModel
from testbed.channel.loss import Chain
from testbed.scenario import BernoulliLoss, FourStateLoss, GilbertElliottLoss, Loss, NoLoss, ScriptedLoss, TraceLoss


def chain_of(loss: Loss) -> LossModel:
    """The chain of arrivals of a loss, or the hidden chain behind it; of what is replayed, that of the assumed law."""
    if isinstance(loss, (TraceLoss, ScriptedLoss)):
        loss = loss.law
    if isinstance(loss, NoLoss):
        return Chain.lossless()
    if isinstance(loss, BernoulliLoss):
        return Chain.bernoulli(loss.arrival)
    if isinstance(loss, GilbertElliottLoss):
        return GilbertElliott.of(loss.to_bad, loss.to_good, loss.loss_good, loss.loss_bad, loss.start_good)
    if isinstance(loss, FourStateLoss):
        return four_state(loss.to_burst, loss.to_good, loss.to_pause, loss.from_pause, loss.to_isolated, loss.start)
    return Chain.markov(loss.recovery, loss.failure, loss.start)
