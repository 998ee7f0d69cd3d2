"""Links over real sockets and through the kernel: messages/s and added latency, beside nothing in between."""

from __future__ import annotations

import os
import time
from collections.abc import Callable
from typing import Any

from benchmarks.figures import Figures, Median, Target, alternate, ratios
from benchmarks.link_ends import KINDS, Found, Work, median
from benchmarks.link_paths import Kernel, Run, direct, measured, relayed

_LOSSES = {"kind": "markov", "loss": 0.05, "mean_burst": 3.0}
_JITTER = {"kind": "uniform", "low": "1 ms", "high": "2 ms"}
_ALL: dict[str, Any] = {
    "loss": _LOSSES,
    "rate": {"bits_per_second": 1e10, "burst_bytes": 100_000},
    "delay": _JITTER,
    "reorder": {"chance": 0.01, "by": "1 ms"},
    "duplicate": {"chance": 0.01},
    "corrupt": {"chance": 0.01},
}
_PIPELINES: dict[str, dict[str, Any]] = {
    "nothing": {},
    "losses": {"loss": _LOSSES},
    "losses and jitter": {"loss": _LOSSES, "delay": _JITTER},
    "all stages": _ALL,
}
_DELAYS_US = (300, 1_000, 10_000)


def run(*, quick: bool) -> Figures:
    repetitions = 2 if quick else 5
    work = Work(30, 200, 0.3) if quick else Work(100, 500, 1.0)
    figures = Figures("links")
    _ends(figures, repetitions, work)
    _pipelines(figures, repetitions, 0.2 if quick else 1.0)
    _relay_at_work(figures, repetitions, work)
    figures.notes.append(
        f"packets and messages of 64 bytes; latencies are one-way; load of the machine {os.getloadavg()[0]:.2f}"
    )
    return figures


def _ends(figures: Figures, repetitions: int, work: Work) -> None:
    kernel = Kernel()
    paths: dict[str, Callable[[str, Work], Run]] = {"direct": direct, "relay": relayed}
    if kernel.missing is None:
        paths["TUN"] = kernel.through
    else:
        figures.notes.append(f"TUN not available: {kernel.missing}")
    cases = {
        (kind, path): (lambda kind=kind, run=run: measured(lambda: run(kind, work)))
        for kind in KINDS
        for path, run in paths.items()
    }
    results = alternate(repetitions, {f"{kind}, {path}": case for (kind, path), case in cases.items()})
    for kind, path in cases:
        ours, beside = results[f"{kind}, {path}"], results[f"{kind}, direct"]
        rates = [each.found.rate for each in ours]
        row: dict[str, Any] = {
            "ends": kind,
            "between": {"relay": "proxy"}.get(path, path) if "tcp" in kind else path,
            "messages/s": Median.of(rates),
            "ratio to direct": ratios(rates, [each.found.rate for each in beside]),
            "µs at 100 Hz": _median_of(ours, "slow_us"),
            "µs at 1 kHz": _median_of(ours, "fast_us"),
        }
        if path != "direct":
            row["added at 100 Hz"] = _added(ours, beside, "slow_us")
            row["added at 1 kHz"] = _added(ours, beside, "fast_us")
        row["CPUs of others"] = Median.of([each.others for each in ours])
        row["lost in flood"] = max(each.found.lost for each in ours)
        figures.rows.append(row)
        if (kind, path) == ("udp socket", "relay"):
            figures.targets.append(Target("UDP relay, packets/s", Median.of(rates).value, 50_000))
            for rate in ("100 Hz", "1 kHz"):
                added = row[f"added at {rate}"].value
                figures.targets.append(
                    Target(f"UDP relay, added median latency at {rate}, µs", added, 150, at_least=False)
                )


def _pipelines(figures: Figures, repetitions: int, seconds: float) -> None:
    results = alternate(
        repetitions, {name: lambda keys=keys: _alone(keys, seconds) for name, keys in _PIPELINES.items()}
    )
    figures.tables["the pipeline alone, in simulated time"] = [
        {"impairments": name, "packets/s": Median.of(rates)} for name, rates in results.items()
    ]


def _alone(keys: dict[str, Any], seconds: float) -> float:
    from testbed.channel.pipeline import Pipeline
    from testbed.scenario.links import Impairments

    pipeline = Pipeline(Impairments.model_validate(keys), 1, "link.observation")
    begun = time.perf_counter()
    while (elapsed := time.perf_counter() - begun) < seconds:
        for number in range(pipeline.sent, pipeline.sent + 1000):
            pipeline.send(64, number * 10_000)
    return pipeline.sent / elapsed


def _relay_at_work(figures: Figures, repetitions: int, work: Work) -> None:
    """The relay with impairments: its rate, and how exactly it keeps a delay."""
    flood, paced = Work(0, 0, work.flood_s), Work(0, work.fast, 0.0)
    busy = {
        name: lambda keys=keys: measured(lambda: relayed("udp socket", flood, keys))
        for name, keys in _PIPELINES.items()
    }
    delays = {
        f"{us} µs": lambda us=us: relayed("udp socket", paced, {"delay": {"kind": "constant", "by": f"{us} us"}})
        for us in _DELAYS_US
    }
    results = alternate(repetitions, {**busy, "none": lambda: relayed("udp socket", paced), **delays})
    figures.tables["UDP relay with impairments"] = [
        {
            "impairments": name,
            "packets/s in": Median.of([each.found.rate / (1 - each.found.lost) for each in results[name]]),
            "CPU µs/packet": Median.of([_cpu_us(each) for each in results[name]]),
            "CPUs of others": Median.of([each.others for each in results[name]]),
            "dropped": Median.of([each.books["dropped"] / each.books["sent"] for each in results[name]]),
            "dropped by the kernel": max(each.books["kernel_dropped"] for each in results[name]),
        }
        for name in busy
    ]
    cpu_us = Median.of([_cpu_us(each) for each in results["nothing"]]).value
    figures.targets.append(Target("UDP relay, packets in a second of its own CPU time", 1e6 / cpu_us, 50_000))
    beside = [median(each.found.fast_us) for each in results["none"]]
    figures.tables["UDP relay, delay kept at 1 kHz"] = [
        {
            "delay": name,
            "µs": _median_of(results[name], "fast_us"),
            "µs too late": Median.of(
                [median(each.found.fast_us) - us - base for each, base in zip(results[name], beside, strict=True)]
            ),
            "99 % of packets": Median.of(
                [_quantile(each.found, 0.99) - us - base for each, base in zip(results[name], beside, strict=True)]
            ),
        }
        for name, us in zip(delays, _DELAYS_US, strict=True)
    ]
    figures.notes.append(
        "µs too late: latency less the delay and less the median latency through the relay without one"
    )


def _cpu_us(run: Run) -> float:
    return 1e6 * run.cpu_s / run.books["sent"]


def _median_of(runs: list[Run], what: str) -> Median:
    return Median.of([median(getattr(each.found, what)) for each in runs])


def _added(ours: list[Run], beside: list[Run], what: str) -> Median:
    def of(run: Run) -> float:
        return median(getattr(run.found, what))

    return Median.of([of(a) - of(b) for a, b in zip(ours, beside, strict=True)])


def _quantile(found: Found, share: float) -> float:
    return sorted(found.fast_us)[int(share * len(found.fast_us))]
