"""The law of what arrives in time, as estimators take it for the losses: lateness counts as loss."""

from __future__ import annotations

from functools import lru_cache

import numpy as np

from testbed.channel.carriers import carriers_of
from testbed.channel.chains import chain_of
from testbed.channel.delay import cdf_of
from testbed.channel.gilbert_elliott import GilbertElliott
from testbed.channel.hidden import Hidden, HiddenChain
from testbed.channel.law import LossModel
from testbed.channel.loss import Chain, LossCounts
from testbed.channel.packets import packet_bytes
from testbed.numerics.lanes import Bools, Floats
from testbed.scenario import Scenario, ScriptedLoss, TraceLoss
from testbed.scenario.durations import parse_duration
from testbed.scenario.impairments import ConstantDelay
from testbed.scenario.links import SteppedImpairments

SAMPLED = 20_000
_SEED = 20_000


def law_of_link(scenario: Scenario, link: str, late: int = 0) -> LossModel:
    """The losses of a link of a scenario as they are seen from step to step, or from ``late`` steps later."""
    settings = getattr(scenario.links, link)
    return law_in_steps(settings, scenario.clock.period_ns, packet_bytes(scenario, link), late)


def law_in_steps(link: SteppedImpairments, period_ns: int, size: int, late: int = 0) -> LossModel:
    """The losses of a link as they are seen from step to step, a packet of ``size`` bytes a period.

    late: a packet counts as lost only if it is later than its deadline by more than so many periods.

    ``assumed`` where it is given. Otherwise exact, but for a clock whose slots do not divide the period (there, the
    mean over their phases), where packets do not depend on each other but through the chain; with a bottleneck,
    with delays in order or with a transport, the Markov chain that fits the counts of a sample of 20,000 packets.
    """
    if link.assumed is not None:
        return chain_of(link.assumed)
    if isinstance(link.loss, TraceLoss | ScriptedLoss):
        link = link.model_copy(update={"loss": link.loss.law})
    if not link.takes_time:
        return chain_of(link.loss)
    until_ns = link.deadline_ns(period_ns) + late * period_ns
    return _exact(link, period_ns, until_ns) if has_formula(link) else _sampled(link, period_ns, until_ns, size)


def has_formula(link: SteppedImpairments) -> bool:
    """Whether the fates of packets depend on each other through the chain of the losses alone."""
    if link.rate is not None or link.transport is not None:
        return False
    return link.delay is None or isinstance(link.delay, ConstantDelay) or not link.delay.in_order


def _exact(link: SteppedImpairments, period_ns: int, until_ns: int) -> LossModel:
    losses = chain_of(link.loss)
    arrives = _arrives_in_time(link, until_ns)
    if link.slot is None and arrives == 1.0:
        return losses
    initial, moves, loss = _hidden_form(losses)
    if link.slot is not None:
        moves = _moved_by_time(moves, period_ns, parse_duration(link.slot))
    loss = 1.0 - (1.0 - loss) * arrives
    if isinstance(losses, Chain | GilbertElliott):
        states = Chain(float(moves[0, 1]), float(moves[1, 0]), float(initial[1]))
        return _simplest(GilbertElliott(states, float(loss[1]), float(loss[0])))
    return _simplest(HiddenChain(tuple(initial), tuple(map(tuple, moves)), tuple(loss)))


def _simplest(losses: Hidden) -> LossModel:
    chain = losses.as_chain
    return losses if chain is None else chain


def _hidden_form(losses: LossModel) -> tuple[Floats, Floats, Floats]:
    """(initial, transition, loss) of the states; of two of them the bad one first."""
    if isinstance(losses, Chain):
        losses = GilbertElliott(losses, 0.0, 1.0)
    return losses.initial, losses.transition, losses.loss


def _moved_by_time(moves: Floats, period_ns: int, slot_ns: int) -> Floats:
    """The moves from packet to packet: as many as slots begin between them, on average over the phases."""
    whole, rest = divmod(period_ns, slot_ns)
    share = rest / slot_ns
    fewer = np.linalg.matrix_power(moves, whole)
    return np.asarray((1.0 - share) * fewer + share * (fewer @ moves))


def _arrives_in_time(link: SteppedImpairments, deadline_ns: int) -> float:
    """P(a copy arrives intact before the deadline | the packet is not lost)."""
    cdf = (lambda ns: float(ns >= 0)) if link.delay is None else cdf_of(link.delay)
    held, by = (0.0, 0) if link.reorder is None else (link.reorder.chance, parse_duration(link.reorder.by))

    def before(ns: int) -> float:
        return (1.0 - held) * cdf(ns) + held * cdf(ns - by)

    intact = 1.0 if link.corrupt is None else 1.0 - link.corrupt.chance
    arrives = intact * before(deadline_ns)
    if link.duplicate is not None:
        after = parse_duration(link.duplicate.after, zero=True)
        arrives += link.duplicate.chance * (1.0 - intact) * intact * before(deadline_ns - after)
    return arrives


@lru_cache(maxsize=16)
def _sampled(link: SteppedImpairments, period_ns: int, until_ns: int, size: int) -> Chain:
    (carrier,), counts = carriers_of(link, _SEED, "law", 0, 1), LossCounts()
    arrived = np.zeros(SAMPLED, dtype=np.bool_)
    for number in range(SAMPLED):
        carrier.send(number, size, number * period_ns)
        _note(arrived, carrier.advance((number + 1) * period_ns - 1), period_ns, until_ns)
    _note(arrived, carrier.advance((SAMPLED - 1) * period_ns + until_ns), period_ns, until_ns)
    for fate in arrived.tolist():
        counts.count(fate)
    (bad, recovered), (failed, good) = counts.transitions
    if not counts.dropped:
        return Chain.lossless()
    if not counts.delivered:
        return Chain.bernoulli(0.0)
    return Chain.markov(recovered / max(1, bad + recovered), failed / max(1, failed + good))


def _note(arrived: Bools, arrivals: list[tuple[int, int]], period_ns: int, until_ns: int) -> None:
    """Which packets have arrived in so much time after they were sent."""
    for at_ns, number in arrivals:
        arrived[number] |= at_ns - number * period_ns <= until_ns
