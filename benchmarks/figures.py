"""Repetitions to figures: medians, spread, ratios, targets; as tables and as JSON."""

from __future__ import annotations

import math
import os
import platform
import statistics
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, field
from importlib.metadata import version
from typing import Any

from rich.console import Console
from rich.table import Table

from benchmarks.cpu import Usage


@dataclass(frozen=True)
class Median:
    """The middle of the repetitions, with the lowest and the highest."""

    value: float
    low: float
    high: float

    @classmethod
    def of(cls, values: Sequence[float]) -> Median:
        return cls(statistics.median(values), min(values), max(values))

    def __str__(self) -> str:
        return f"{_short(self.value)} ({_short(self.low)} … {_short(self.high)})"


@dataclass(frozen=True)
class Target:
    """``value`` against what it should reach."""

    text: str
    value: float
    bound: float
    at_least: bool = True

    @property
    def met(self) -> bool:
        return self.value >= self.bound if self.at_least else self.value <= self.bound


@dataclass
class Figures:
    """What one benchmark found."""

    name: str
    rows: list[dict[str, Any]] = field(default_factory=list)
    targets: list[Target] = field(default_factory=list)
    cpu: dict[str, list[dict[str, Any]]] = field(default_factory=dict)
    tables: dict[str, list[dict[str, Any]]] = field(default_factory=dict)
    """Further tables by title."""
    notes: list[str] = field(default_factory=list)

    def print(self, console: Console) -> None:
        console.print(_table(self.name, self.rows))
        for title, rows in (*self.tables.items(), *self.cpu.items()):
            console.print(_table(f"{self.name}: {title}", rows))
        for note in self.notes:
            console.print(f"  {note}", highlight=False)
        for target in self.targets:
            verdict = "[green]met[/]" if target.met else "[red]missed[/]"
            sign = "≥" if target.at_least else "≤"
            console.print(f"  {verdict}  {target.text}: {_short(target.value)} (target {sign} {_short(target.bound)})")
        console.print()

    def to_json(self) -> dict[str, Any]:
        rows, tables = _plain(self.rows), {title: _plain(rows) for title, rows in self.tables.items()}
        targets = [{**asdict(target), "met": target.met} for target in self.targets]
        for target in targets:
            target["value"] = target["value"] if math.isfinite(target["value"]) else None
        return {"rows": rows, "tables": tables, "targets": targets, "cpu": self.cpu, "notes": self.notes}


def _plain(rows: list[dict[str, Any]]) -> list[dict[str, Any]]:
    return [{k: asdict(v) if isinstance(v, Median) else v for k, v in row.items()} for row in rows]


def alternate(repetitions: int, cases: dict[str, Callable[[], Any]]) -> dict[str, list[Any]]:
    """Run every case in turn, ``repetitions`` times over, so that all see the same changes of the machine."""
    out: dict[str, list[Any]] = {name: [] for name in cases}
    for _ in range(repetitions):
        for name, case in cases.items():
            out[name].append(case())
    return out


def ratios(ours: Sequence[float], theirs: Sequence[float]) -> Median:
    """Ratio of neighbours in time."""
    return Median.of([a / b for a, b in zip(ours, theirs, strict=True)])


def cpu_rows(results: Sequence[Any], floor: dict[str, float] | None = None) -> list[dict[str, Any]]:
    """role, CPU seconds, share, µs a step (of the repetition with the median total), and the floor's µs beside it."""
    result = sorted(results, key=lambda r: r.cpu_us_per_step)[len(results) // 2]
    usage: Usage = result.cpu
    total = sum(sum(parts.values()) for parts in usage.values()) or 1.0
    rows = []
    for role, parts in sorted(usage.items()):
        seconds = sum(parts.values())
        row: dict[str, Any] = {"role": role, "CPU s": seconds, "share %": 100 * seconds / total}
        row["µs/step"] = 1e6 * seconds / result.steps
        row["main thread"] = 1e6 * parts.get("main", 0.0) / result.steps
        row["zenoh threads"] = 1e6 * parts.get("transport", 0.0) / result.steps
        if floor is not None:
            row["floor µs/step"] = floor.get(role, 0.0)
        rows.append(row)
    whole: dict[str, Any] = {"role": "all", "CPU s": total, "share %": 100.0, "µs/step": 1e6 * total / result.steps}
    for column in ("main thread", "zenoh threads", *(["floor µs/step"] if floor is not None else [])):
        whole[column] = sum(row[column] for row in rows)
    return [*rows, whole]


def machine() -> dict[str, Any]:
    """What the figures were taken on."""
    names = ("eclipse-zenoh", "numpy", "pydantic")
    return {
        "cpus": len(os.sched_getaffinity(0)),
        "machine": platform.machine(),
        "system": f"{platform.system()} {platform.release()}",
        "python": platform.python_version(),
        "load": os.getloadavg(),
        **{name: version(name) for name in names},
    }


def _table(title: str, rows: list[dict[str, Any]]) -> Table:
    table = Table(title=title, title_justify="left")
    columns = list(dict.fromkeys(key for row in rows for key in row))
    for i, column in enumerate(columns):
        table.add_column(column, justify="left" if i == 0 else "right")
    for row in rows:
        table.add_row(*(_cell(row.get(column, "")) for column in columns))
    return table


def _cell(value: Any) -> str:
    return _short(value) if isinstance(value, float) else str(value)


def _short(value: float) -> str:
    if abs(value) >= 100:
        return f"{value:,.0f}"
    return f"{value:.3g}"
