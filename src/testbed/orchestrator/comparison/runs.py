"""Runs read back from their folders, and what differs between two of them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from testbed.errors import UsageError
from testbed.orchestrator.lanes_file import NAME, LaneFigures, read_lanes
from testbed.orchestrator.summary import Summary, read_summary
from testbed.scenario import ClosedLoop, Scenario, load_scenario, to_dict

_NOISE = ("seed", "lanes", "steps", "system", "uncertainty", "cost")
_COURSE = ("input", "actuator", "links", "clock", "events")


@dataclass(frozen=True)
class RunFigures:
    """One run; ``label``: what it is called in a comparison."""

    label: str
    scenario: Scenario
    summary: Summary
    lanes: LaneFigures


def load_runs(folders: Sequence[Path]) -> list[RunFigures]:
    """The runs of folders, each labelled by the last parts of its path that tell it from the others.

    Raises UsageError where a folder is none of a run, or is given twice.
    """
    whole = [folder.resolve() for folder in folders]
    for i, path in enumerate(whole):
        if path in whole[:i]:
            raise UsageError(f"{folders[i]}: given twice; allowed: each run once")
    depth = 1
    while len({path.parts[-depth:] for path in whole}) < len(whole):
        depth += 1
    return [load_run(folder, "/".join(path.parts[-depth:])) for folder, path in zip(folders, whole, strict=True)]


def load_run(folder: Path, label: str | None = None) -> RunFigures:
    """The run of a folder. Raises UsageError where it is none, or its files cannot be read."""
    if not (folder / "summary.json").is_file():
        what = "no summary.json in it" if folder.is_dir() else "no such folder"
        raise UsageError(f"{folder}: {what}; allowed: the folder of a run that is over")
    try:
        summary = read_summary(folder / "summary.json")
    except OSError as error:
        raise UsageError(f"cannot read {folder / 'summary.json'}: {(error.strerror or str(error)).lower()}") from None
    lanes = read_lanes(folder / NAME)
    wide = {values.shape[1] for values in lanes.all}
    if set(lanes.figures) != set(summary.estimators) or wide - {summary.lanes}:
        raise UsageError(f"{folder}: {NAME} and summary.json are not of the same run")
    return RunFigures(label or folder.resolve().name, load_scenario(folder / "scenario.toml"), summary, lanes)


def apart(one: RunFigures, other: RunFigures) -> list[str]:
    """What keeps the lanes of two runs from meeting the same noise at the same steps of the same plant.

    The input counts unless it follows an estimate: closed loops may differ in their controllers.
    """
    keys = [*_NOISE]
    if not _closed(one) and not _closed(other):
        keys.append("input")
    return _differing(one, other, keys)


def besides(one: RunFigures, other: RunFigures) -> list[str]:
    """What else differs of the course of two runs whose noise is the same."""
    return [key for key in _differing(one, other, _COURSE) if key not in apart(one, other)]


def _closed(run: RunFigures) -> bool:
    return isinstance(run.scenario.input, ClosedLoop)


def _differing(one: RunFigures, other: RunFigures, keys: Sequence[str]) -> list[str]:
    a, b = to_dict(one.scenario), to_dict(other.scenario)
    return [name for key in keys for name in _differences(key, a.get(key), b.get(key))]


def _differences(name: str, a: Any, b: Any) -> list[str]:
    """The keys, such as links.control.loss.failure, whose values differ; a number with both values."""
    if a == b:
        return []
    if isinstance(a, dict) and isinstance(b, dict) and a.get("kind") == b.get("kind"):
        return [found for key in {**a, **b} for found in _differences(f"{name}.{key}", a.get(key), b.get(key))]
    if all(isinstance(value, (int, float, str)) and len(str(value)) < 20 for value in (a, b)):
        return [f"{name} ({a}, {b})"]
    return [name]
