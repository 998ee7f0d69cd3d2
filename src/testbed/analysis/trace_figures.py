"""Everything a trace says about its link: losses, bursts and gaps, delays, order, copies; and a model beside it."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from testbed.analysis.correlation import autocorrelation, share_interval
from testbed.analysis.fit import PACKETS_MIN
from testbed.analysis.fit_goodness import Goodness, goodness, runs
from testbed.analysis.fit_intervals import Interval, Z, wilson
from testbed.analysis.trace_delays import LEVELS, Quantile, quantiles
from testbed.analysis.trace_order import Reordering, reordering
from testbed.channel.law import LossModel, law_of, stationary_of
from testbed.errors import UsageError
from testbed.numerics.lanes import Bools, Floats

_LAGS_MAX = 50
_WINDOWS_MAX = 60
_WINDOW_MIN = 20


@dataclass(frozen=True, eq=False)
class Packets:
    """A trace by packet, in the order of their numbers.

    arrived (n,). sent_ns (n,), from the first one on. delays_ns: of the first arrival of each packet that arrived.
    order (a,) and order_ns (a,): numbers and times of first arrivals, in the order of arrival. copies: arrivals beyond
    the first.
    """

    arrived: Bools
    sent_ns: NDArray[np.int64]
    delays_ns: NDArray[np.int64]
    order: NDArray[np.int64]
    order_ns: NDArray[np.int64]
    copies: int

    @classmethod
    def of(cls, rows: Sequence[tuple[int, int, int | None]]) -> Packets:
        """From the rows of a trace, whose numbers leave no gap. Raises UsageError for times beyond 63 bits."""
        first: dict[int, tuple[int, int | None]] = {}
        arrivals = 0
        for seq, sent, at in rows:
            arrivals += at is not None
            before = first.get(seq)
            if before is None or before[1] is None or (at is not None and at < before[1]):
                first[seq] = (sent, at)
        numbers = sorted(first)
        start = first[numbers[0]][0] if numbers else 0
        times = [(seq, at) for seq in numbers if (at := first[seq][1]) is not None]
        times.sort(key=lambda entry: entry[1])
        try:
            return cls(
                np.array([first[seq][1] is not None for seq in numbers], dtype=np.bool_),
                np.array([first[seq][0] - start for seq in numbers], dtype=np.int64),
                np.array([at - first[seq][0] for seq in numbers if (at := first[seq][1]) is not None], dtype=np.int64),
                np.array([seq - numbers[0] for seq, _ in times], dtype=np.int64),
                np.array([at - start for _, at in times], dtype=np.int64),
                arrivals - len(times),
            )
        except OverflowError:
            raise UsageError("got times more than 2^63 ns apart; allowed: less") from None


@dataclass(frozen=True)
class Model:
    """What a trace is compared with. name: as in a sentence. fitted: parameters that come from the trace itself.

    delay: the quantile function of the delays, in ns, where one is known.
    """

    name: str
    losses: LossModel
    fitted: int
    delay: Callable[[float], int] | None = None


@dataclass(frozen=True)
class ModelFigures:
    """What the model says of the losses.

    expected: between which shares lost 95 % of traces of this length lie, in the stationary law; None for a model that
    was fitted to this trace. goodness: of the lengths of bursts and gaps together.
    """

    name: str
    loss_rate: float
    expected: Interval | None
    mean_burst: float | None
    correlation: list[float]
    goodness: Goodness


@dataclass(frozen=True)
class Window:
    """Packets first … last, counted from 0, and the share of them that was lost."""

    first: int
    last: int
    loss_rate: float


@dataclass(frozen=True)
class TraceFigures:
    """interval: 95 %, from the correlation of the trace itself; independent_interval: were its losses independent.

    correlation_time: how many packets tell as much as one independent one. band: where 95 % of the autocorrelations of
    independent losses lie, ±. delays: empty where the trace has none; why_no_delays says why.
    """

    packets: int
    delivered: int
    lost: int
    copies: int
    loss_rate: float
    interval: Interval
    independent_interval: Interval
    correlation_time: float
    bursts: int
    mean_burst: float | None
    longest_burst: int
    mean_gap: float | None
    correlation: list[float]
    band: float
    windows: list[Window]
    delays: tuple[Quantile, ...]
    why_no_delays: str
    reordering: Reordering
    model: ModelFigures | None


def trace_figures(packets: Packets, model: Model | None) -> TraceFigures:
    """The figures of a trace of at least one packet. Raises UsageError for an empty one."""
    number = len(packets.arrived)
    if number == 0:
        raise UsageError("got no packet; allowed: one or more")
    gone = ~packets.arrived
    lost = int(np.count_nonzero(gone))
    interval, tau = share_interval(gone)
    bursts = int(np.count_nonzero(gone[1:] & ~gone[:-1])) + int(gone[0])
    lags = min(_LAGS_MAX, number // 4)
    gaps = runs(packets.arrived, True)
    moving = bool(packets.delays_ns.size and packets.delays_ns.any())
    return TraceFigures(
        packets=number,
        delivered=number - lost,
        lost=lost,
        copies=packets.copies,
        loss_rate=lost / number,
        interval=interval,
        independent_interval=wilson(lost, number),
        correlation_time=tau,
        bursts=bursts,
        mean_burst=lost / bursts if bursts else None,
        longest_burst=_longest(gone),
        mean_gap=float(gaps.mean()) if len(gaps) else None,
        correlation=[float(value) for value in autocorrelation(gone.astype(np.float64), lags)],
        band=Z / math.sqrt(number),
        windows=_windows(gone),
        delays=_delays(packets.delays_ns, model) if moving else (),
        why_no_delays="" if moving else "every delivered_ns is its sent_ns" if number > lost else "nothing arrived",
        reordering=reordering(packets.order, packets.order_ns),
        model=None if model is None else _beside(packets.arrived, model, lags),
    )


def _longest(gone: Bools) -> int:
    edges = np.flatnonzero(np.diff(np.concatenate([[0], gone.astype(np.int8), [0]])))
    return int(np.max(edges[1::2] - edges[::2], initial=0))


def _windows(gone: Bools) -> list[Window]:
    count = max(1, min(_WINDOWS_MAX, len(gone) // _WINDOW_MIN))
    edges = [len(gone) * i // count for i in range(count + 1)]
    return [Window(a, b - 1, float(gone[a:b].mean())) for a, b in pairwise(edges)]


def _delays(delays_ns: NDArray[np.int64], model: Model | None) -> tuple[Quantile, ...]:
    found = quantiles(delays_ns)
    if model is None or model.delay is None:
        return found
    return tuple(
        Quantile(q.level, q.value, q.low, q.high, model.delay(level)) for q, level in zip(found, LEVELS, strict=True)
    )


def _beside(arrived: Bools, model: Model, lags: int) -> ModelFigures:
    losses = model.losses
    rate, spread = share_of_losses(losses, len(arrived))
    bounds = Interval(max(0.0, rate - Z * spread), min(1.0, rate + Z * spread))
    return ModelFigures(
        model.name,
        rate,
        None if model.fitted else bounds,
        None if losses.never_loses else losses.mean_burst,
        [float(value) for value in correlation_of(losses, lags)],
        goodness(arrived, losses, model.fitted),
    )


def share_of_losses(losses: LossModel, number: int) -> tuple[float, float]:
    """The probability of a loss and the standard deviation of the share lost of so many packets, stationary."""
    return 1.0 - losses.arrival, math.sqrt(max(0.0, losses.share_moments(number)[1]))


def correlation_of(losses: LossModel, lags: int) -> Floats:
    """Corr(γ_0, γ_j), j = 0 … lags, in the stationary law; zero but for the first where fates never differ."""
    law, pi = law_of(losses), stationary_of(losses)
    lost = (~law.arrived).astype(np.float64)
    rate = float(pi @ lost)
    out, ahead = np.zeros(lags + 1), lost
    out[0] = 1.0
    if 0.0 < rate < 1.0:
        for j in range(1, lags + 1):
            ahead = law.transition @ ahead
            out[j] = (float((pi * lost) @ ahead) - rate**2) / (rate * (1.0 - rate))
    return out


def can_be_fitted(arrived: Bools) -> bool:
    """Whether there is enough in a trace to fit a loss model to it."""
    lost = len(arrived) - int(np.count_nonzero(arrived))
    return len(arrived) >= PACKETS_MIN and 0 < lost < len(arrived)
