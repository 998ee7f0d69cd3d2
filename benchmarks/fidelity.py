"""Models of transports against real zenoh through the kernel: delays over tcp, losses over udp."""

from __future__ import annotations

import multiprocessing
import os
import subprocess
import threading
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor, ThreadPoolExecutor
from fnmatch import fnmatchcase
from typing import Any

import numpy as np

from benchmarks.cpu import Busy
from benchmarks.fidelity_cells import Cell, Seen, quantiles, tcp_cells, udp_cells
from benchmarks.fidelity_model import fragments, law_of_messages, modelled
from benchmarks.fidelity_real import Failed, through_kernel
from benchmarks.figures import Figures, Target
from testbed.errors import TestbedError

_SECONDS, _QUICK_SECONDS = 300.0, 20.0
_AT_ONCE = 10
_RUNS, _RUNS_UDP = 6, 40
_NORMAL_95 = 1.96
_HELD_TO_PERCENT = 5
_ERROR_MAX = 0.3

Pair = tuple[Seen, list[Seen]]
"""What real zenoh saw, and what runs of the model of the same length did."""


class Numbers(tuple[float, ...]):
    """Shown in one column."""

    def __str__(self) -> str:
        return " / ".join(f"{number:,.0f}" if abs(number) >= 100 else f"{number:.3g}" for number in self)


def names() -> list[str]:
    return [cell.name for cell in (*tcp_cells(), *udp_cells())]


def unmatched(patterns: Sequence[str]) -> str | None:
    """The first pattern that is of no cell."""
    return next((p for p in patterns if not any(fnmatchcase(name, p) for name in names())), None)


def run(*, quick: bool, seconds: float | None = None, cells: Sequence[str] | None = None) -> Figures:
    """cells: patterns of names; the cell without losses that a tcp cell is compared with comes along."""
    seconds = seconds or (_QUICK_SECONDS if quick else _SECONDS)
    chosen = _chosen(cells)
    figures = Figures("fidelity")
    busy, before = Busy(), _own_s()
    real, failed = _measure(chosen, seconds)
    others = busy.others(_own_s() - before)
    pairs = _compare(real, seconds)
    _tcp(figures, pairs)
    _udp(figures, pairs)
    figures.notes += [f"{cell.name}: no figures: {why}" for cell, why in failed]
    notes = [seen.notes for seen in real.values()]
    figures.notes.append(
        f"{seconds:g} s a cell, {_AT_ONCE} at once; ends with real-time priority: "
        f"{'yes' if all(note['real_time'] for note in notes) else 'no'}; CPUs of others {others:.2f}; "
        f"puts behind their time, median at most {max((note['behind_ms'] for note in notes), default=0):.2f} ms; "
        f"packets that the TUN link wrote more than 1 ms late: {sum(note['overdue'] for note in notes)}"
    )
    return figures


def _chosen(patterns: Sequence[str] | None) -> list[Cell]:
    everything = [*tcp_cells(), *udp_cells()]
    if patterns is None:
        return everything
    chosen = {cell for cell in everything if any(fnmatchcase(cell.name, p) for p in patterns)}
    delays = {cell.delay_ms for cell in chosen if cell.transport == "tcp"}
    return [
        cell
        for cell in everything
        if cell in chosen or (cell.transport == "tcp" and not cell.percent and cell.delay_ms in delays)
    ]


def _own_s() -> float:
    return sum(os.times()[:4])


def _measure(cells: list[Cell], seconds: float) -> tuple[dict[Cell, Seen], list[tuple[Cell, str]]]:
    """Several at once: each keeps the machine busy for a few per cent of the time."""
    real: dict[Cell, Seen] = {}
    failed: list[tuple[Cell, str]] = []
    stop = threading.Event()
    with ThreadPoolExecutor(_AT_ONCE) as pool:
        try:
            begun = {cell: pool.submit(through_kernel, cell, seconds, stop) for cell in cells}
            for cell, future in begun.items():
                try:
                    real[cell] = future.result()
                except (Failed, TestbedError, OSError, subprocess.SubprocessError) as error:
                    failed.append((cell, str(error)))
        finally:
            stop.set()
            pool.shutdown(cancel_futures=True)
    return real, failed


def _compare(real: dict[Cell, Seen], seconds: float) -> dict[Cell, Pair]:
    """The model's delay is that of the real path, both ways: the median of the cell without losses."""
    offsets = {
        cell.delay_ms: quantiles(seen.delays_ms)[0] - cell.delay_ms
        for cell, seen in real.items()
        if cell.transport == "tcp" and not cell.percent
    }
    with ProcessPoolExecutor(2, mp_context=multiprocessing.get_context("spawn")) as pool:
        begun = {}
        for cell in real:
            if cell.transport == "tcp" and cell.delay_ms not in offsets:
                continue
            offset = offsets[cell.delay_ms] if cell.transport == "tcp" else 0.0
            runs = _RUNS if cell.transport == "tcp" else _RUNS_UDP
            begun[cell] = [pool.submit(modelled, cell, seconds, offset, seed) for seed in range(1, runs + 1)]
        return {cell: (real[cell], [future.result() for future in futures]) for cell, futures in begun.items()}


def _tcp(figures: Figures, pairs: dict[Cell, Pair]) -> None:
    errors: list[float] = []
    for cell, (seen, runs) in pairs.items():
        if cell.transport != "tcp":
            continue
        ours = quantiles(np.sort(np.concatenate([run.delays_ms for run in runs])))
        theirs = quantiles(seen.delays_ms)
        each = np.array([quantiles(run.delays_ms) for run in runs])
        ratio = Numbers(a / b for a, b in zip(ours, theirs, strict=True))
        figures.rows.append(
            {
                "one way, ms": cell.delay_ms,
                "loss, %": cell.percent,
                "zenoh, ms": Numbers(theirs),
                "model, ms": Numbers(ours),
                "its least": Numbers(each.min(axis=0).tolist()),
                "its most": Numbers(each.max(axis=0).tolist()),
                "model/zenoh": ratio,
                "together, %": Numbers([100 * seen.together, 100 * _mean(run.together for run in runs)]),
                "time-outs a minute": Numbers([_a_minute(seen), _mean(map(_a_minute, runs))]),
                "outages": Numbers([seen.outages, _mean(run.outages for run in runs)]),
                "lost, %": Numbers([100 * seen.loss, 100 * _mean(run.loss for run in runs)]),
            }
        )
        if cell.percent <= _HELD_TO_PERCENT:
            errors += [abs(part - 1.0) for part in ratio[:2]]
    if figures.rows:
        text = f"largest relative error of the model at 50 and 90 %, up to {_HELD_TO_PERCENT} % loss"
        figures.targets.append(Target(text, max(errors, default=float("nan")), _ERROR_MAX, at_least=False))
        figures.notes.append(
            f"delays of messages at 50 / 90 / 99 %; the model's of {_RUNS} runs together, and the least and most of "
            "one; pairs: zenoh / model. Its delay each way is zenoh's median without losses"
        )


def _udp(figures: Figures, pairs: dict[Cell, Pair]) -> None:
    rows: list[dict[str, Any]] = []
    for cell, (seen, runs) in pairs.items():
        if cell.transport != "udp":
            continue
        losses = [run.loss for run in runs]
        packets, spread = fragments(cell.size), float(np.std(losses, ddof=1))
        mean, by = _mean(losses), "model"
        if "loss" in cell.link:
            mean, spread = law_of_messages(cell.link, packets, seen.messages)
            by = "law"
        low, high = mean - _NORMAL_95 * spread, mean + _NORMAL_95 * spread
        rows.append(
            {
                "cell": cell.name,
                "messages": seen.messages,
                "packets each": packets,
                "expected, %": 100 * mean,
                "95 % of runs": f"{100 * low:.2f} … {100 * high:.2f}",
                "by": by,
                "model, %": 100 * _mean(losses),
                "zenoh, %": 100 * seen.loss,
                "deviations": (seen.loss - mean) / spread if spread else 0.0,
                "within": "yes" if low <= seen.loss <= high else "no",
            }
        )
    if rows:
        figures.tables["messages lost over udp"] = rows
        share = sum(row["within"] == "yes" for row in rows) / len(rows)
        figures.targets.append(Target("udp: share of cells within the interval of the chain", share, 1.0))
        figures.notes.append(
            "udp: the interval of 95 % is that of the chain, of all pairs of messages; with jitter that of "
            f"{_RUNS_UDP} runs of the model, in which late messages are lost"
        )


def _mean(values: Any) -> float:
    found = list(values)
    return float(sum(found) / len(found))


def _a_minute(seen: Seen) -> float:
    return seen.timeouts / (seen.messages * seen.period_ms / 60_000)
