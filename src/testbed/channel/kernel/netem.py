"""What of a link ``tc netem`` can express, in its words; the rest is refused. Never its "correlation" of losses:
by its formula "5 % 25 %" loses 0.19 %.
"""

from __future__ import annotations

from testbed.errors import UsageError
from testbed.scenario.durations import parse_duration
from testbed.scenario.impairments import ConstantDelay, Delay, NormalDelay, Rate, Reorder, UniformDelay
from testbed.scenario.links import Impairments
from testbed.scenario.loss_laws import BernoulliLoss, FourStateLoss, GilbertElliottLoss, MarkovLoss, NoLoss
from testbed.scenario.losses import Loss

_NO_LIMIT = 1_000_000
"""Packets; netem's own limit of 1000 would drop at high rates."""


def netem_arguments(impairments: Impairments) -> list[str]:
    """What stands behind "tc qdisc add dev DEVICE root netem"; [] if the link does nothing.

    Raises UsageError where netem has no word for it.
    """
    if not isinstance(impairments.loss, NoLoss) and impairments.clock == "time":
        raise _refusal("clock", "'time'", "'packet', which is what moves its chains")
    words = _loss(impairments.loss)
    if impairments.reorder is not None:
        words += _reorder(impairments.reorder, impairments.delay)
    elif impairments.delay is not None:
        words += _delay(impairments.delay)
    if impairments.duplicate is not None:
        if parse_duration(impairments.duplicate.after, zero=True):
            raise _refusal("duplicate.after", repr(impairments.duplicate.after), "'0 s'")
        words += ["duplicate", _percent(impairments.duplicate.chance)]
    if impairments.corrupt is not None:
        words += ["corrupt", _percent(impairments.corrupt.chance)]
    limit = _NO_LIMIT
    if impairments.rate is not None:
        words += _rate(impairments.rate)
        if impairments.rate.queue_packets is not None:
            if impairments.delay is not None or impairments.reorder is not None:
                raise _refusal("rate.queue_packets", f"{impairments.rate.queue_packets} with a delay", "one of the two")
            limit = impairments.rate.queue_packets
    return ["limit", str(limit), *words] if words else []


def _loss(loss: Loss) -> list[str]:
    if isinstance(loss, NoLoss):
        return []
    if isinstance(loss, BernoulliLoss):
        return ["loss", "random", _percent(1.0 - loss.arrival)]
    if isinstance(loss, MarkovLoss):
        if loss.start not in (None, 1.0):
            raise _refusal("loss.start", f"{loss.start:g}", "none; its chains start in the good state")
        return ["loss", "gemodel", _percent(loss.failure), _percent(loss.recovery), "100%", "0%"]
    if isinstance(loss, GilbertElliottLoss):
        if loss.start_good not in (None, 1.0):
            raise _refusal("loss.start_good", f"{loss.start_good:g}", "none; its chains start in the good state")
        return ["loss", "gemodel", *map(_percent, (loss.to_bad, loss.to_good, loss.loss_bad, loss.loss_good))]
    if isinstance(loss, FourStateLoss):
        if loss.start is not None:
            raise _refusal("loss.start", "probabilities", "none; its chains start in the good state")
        chances = (loss.to_burst, loss.to_good, loss.to_pause, loss.from_pause, loss.to_isolated)
        return ["loss", "state", *map(_percent, chances)]
    raise _refusal("loss.kind", repr(loss.kind), "'none', 'bernoulli', 'markov', 'gilbert-elliott', 'four-state'")


def _delay(delay: Delay) -> list[str]:
    if isinstance(delay, ConstantDelay):
        by = parse_duration(delay.by, zero=True)
        return ["delay", _time(by)] if by else []
    if delay.in_order:
        raise _refusal("delay.in_order", "true", "false, or a constant delay")
    if isinstance(delay, UniformDelay):
        low, high = (parse_duration(text, zero=True) for text in (delay.low, delay.high))
        return ["delay", _time((low + high) // 2), _time((high - low) // 2)]
    if isinstance(delay, NormalDelay):
        mean, std, least = (parse_duration(text, zero=True) for text in (delay.mean, delay.std, delay.minimum))
        if least or mean < 4 * std:
            raise _refusal("delay", "a normal law that is cut off", "minimum = '0 s' and mean at least 4 std")
        return ["delay", _time(mean), _time(std), "distribution", "normal"]
    raise _refusal("delay.kind", repr(delay.kind), "'constant', 'uniform', 'normal'")


def _reorder(reorder: Reorder, delay: Delay | None) -> list[str]:
    """netem's "reorder" is the share that is not delayed."""
    if delay is not None and not (isinstance(delay, ConstantDelay) and not parse_duration(delay.by, zero=True)):
        raise _refusal("reorder", "reorder with a delay", "one of the two")
    return ["delay", _time(parse_duration(reorder.by)), "reorder", _percent(1.0 - reorder.chance)]


def _rate(rate: Rate) -> list[str]:
    if rate.burst_bytes:
        raise _refusal("rate.burst_bytes", str(rate.burst_bytes), "0")
    if rate.queue_bytes is not None:
        raise _refusal("rate.queue_bytes", str(rate.queue_bytes), "queue_packets")
    overhead = [str(rate.overhead_bytes)] if rate.overhead_bytes else []
    return ["rate", f"{round(rate.bits_per_second)}bit", *overhead]


def _percent(chance: float) -> str:
    return f"{100.0 * chance:.9g}%"


def _time(ns: int) -> str:
    return f"{ns}ns"


def _refusal(key: str, got: str, allowed: str) -> UsageError:
    return UsageError(f"backend netem: {key}: got {got}; allowed: {allowed}; backend tun can do it")
