"""The pictures of a trace."""

from __future__ import annotations

from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from testbed.analysis.bursts import run_law
from testbed.analysis.fit_goodness import runs
from testbed.analysis.trace_figures import Model, Packets, TraceFigures
from testbed.numerics.lanes import Floats
from testbed.orchestrator.report.svg import COLOURS, GREY, WIDTH_IN

_HEIGHT_IN = 2.4
_POINTS_MAX = 2000
_SEEN: dict[str, Any] = {"linestyle": "", "marker": "o", "markersize": 3.2, "color": COLOURS[0]}
_LAW: dict[str, Any] = {"color": COLOURS[1], "linewidth": 1.2}
_MS = 1e6


def losses(figures: TraceFigures) -> Figure:
    """The share lost along the trace."""
    figure = Figure(figsize=(WIDTH_IN, _HEIGHT_IN))
    axes = figure.subplots()
    edges = [window.first for window in figures.windows] + [figures.windows[-1].last + 1]
    axes.axhspan(figures.interval.low, figures.interval.high, color="#9a9a9a", alpha=0.3, linewidth=0)
    axes.stairs([window.loss_rate for window in figures.windows], edges, color=COLOURS[0], linewidth=1.2)
    if figures.model is not None:
        axes.axhline(figures.model.loss_rate, **_LAW)
    axes.set_xlabel("packet")
    axes.set_ylabel("share lost")
    axes.set_ylim(bottom=0.0)
    axes.set_xlim(0, figures.packets)
    axes.xaxis.set_major_locator(MaxNLocator(integer=True))
    return figure


def tails(packets: Packets, model: Model | None) -> Figure:
    """How many bursts and gaps are longer than so many packets."""
    figure = Figure(figsize=(WIDTH_IN, _HEIGHT_IN))
    for axes, fate, name in zip(figure.subplots(1, 2), (False, True), ("burst of losses", "gap between"), strict=True):
        lengths, shares, law = tail(packets, model, fate)
        axes.semilogy(lengths, shares, **_SEEN)
        if law is not None:
            axes.semilogy(lengths, law, **_LAW)
        axes.set_xlabel(f"length of a {name} (packets)")
        axes.set_ylabel("share that is as long or longer")
        axes.xaxis.set_major_locator(MaxNLocator(integer=True))
        _empty(axes, len(lengths))
    return figure


def tail(packets: Packets, model: Model | None, fate: bool) -> tuple[Floats, Floats, Floats | None]:
    """Lengths that occur, the share of whole runs as long or longer, and that of the model's law."""
    found = runs(packets.arrived, fate)
    lengths, counts = np.unique(found, return_counts=True)
    shares = counts[::-1].cumsum()[::-1] / max(1, len(found))
    law = None if model is None else run_law(model.losses, fate)
    theory = None if law is None else np.array([max(law.tail(int(length) - 1), 1e-300) for length in lengths])
    return lengths.astype(np.float64), shares.astype(np.float64), theory


def correlation(figures: TraceFigures) -> Figure:
    """Autocorrelation of the losses."""
    figure = Figure(figsize=(WIDTH_IN, _HEIGHT_IN))
    axes = figure.subplots()
    lags = np.arange(1, len(figures.correlation))
    axes.axhspan(-figures.band, figures.band, color="#9a9a9a", alpha=0.3, linewidth=0)
    axes.axhline(0.0, color=GREY, linewidth=0.6)
    axes.plot(lags, figures.correlation[1:], **_SEEN)
    if figures.model is not None:
        axes.plot(lags, figures.model.correlation[1:], **_LAW)
    axes.set_xlabel("lag (packets)")
    axes.set_ylabel("autocorrelation of losses")
    axes.xaxis.set_major_locator(MaxNLocator(integer=True))
    return figure


def delays(packets: Packets, model: Model | None) -> Figure:
    """Delays along the trace, and the share of packets that take longer."""
    figure = Figure(figsize=(WIDTH_IN, _HEIGHT_IN), dpi=200)
    along, above = figure.subplots(1, 2)
    sent_s, delays_ms = thinned(packets.sent_ns[packets.arrived] / 1e9, packets.delays_ns / _MS)
    along.plot(sent_s, delays_ms, linestyle="", marker=".", markersize=1.5, color=COLOURS[0], rasterized=True)
    along.set_xlabel("sent at (s)")
    along.set_ylabel("delay (ms)")
    ordered, shares = exceeded(packets)
    above.semilogy(ordered, shares, color=COLOURS[0], drawstyle="steps-post")
    if model is not None and model.delay is not None:
        levels = 1.0 - np.logspace(0.0, -np.log10(2.0 * len(packets.delays_ns)), 200)
        above.semilogy([model.delay(float(level)) / _MS for level in levels], 1.0 - levels, **_LAW)
    above.set_xlabel("delay (ms)")
    above.set_ylabel("share that takes longer")
    return figure


def thinned(x: Floats, y: Floats) -> tuple[Floats, Floats]:
    """At most so many points as can be told apart: one in so many, and the largest y."""
    stride = -(-len(x) // _POINTS_MAX)
    kept = np.union1d(np.arange(0, len(x), stride), np.argsort(y)[-20:])
    return x[kept], y[kept]


def exceeded(packets: Packets) -> tuple[Floats, Floats]:
    """Delays in ms in their order and the share of longer ones, thinned where there are many."""
    ordered = np.sort(packets.delays_ns) / _MS
    number = len(ordered)
    ranks = np.arange(number)
    if number > _POINTS_MAX:  # evenly along the logarithm of the share that is longer
        ranks = np.unique(number - np.logspace(0.0, np.log10(number), _POINTS_MAX).astype(np.int64))
    return ordered[ranks], (number - ranks - 0.5) / number


def _empty(axes: Axes, count: int) -> None:
    if not count:
        axes.text(0.5, 0.5, "none", transform=axes.transAxes, ha="center", va="center", color=GREY)
