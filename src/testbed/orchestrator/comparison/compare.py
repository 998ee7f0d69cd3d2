"""Differences between estimators of one run or of several, lane by lane."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import combinations

import numpy as np
from numpy.typing import NDArray

from testbed.analysis.batch_means import batched
from testbed.analysis.differences import Difference, holm, paired, welch
from testbed.errors import UsageError, did_you_mean
from testbed.numerics.lanes import Floats
from testbed.orchestrator.comparison.runs import RunFigures, apart, besides
from testbed.orchestrator.lane_windows import first_settled
from testbed.orchestrator.statistics import LANE_FIGURES

_NORMALISED = {"nees"}
"""Figures whose law does not depend on how large the covariance is: losses do not make their moments infinite."""
_BLURRED = {"squared_error", "nees"}
"""Those that rounding of a large state spoils."""


@dataclass(frozen=True)
class Item:
    """One estimator of one run; ``estimator`` None: the run as a whole."""

    run: str
    estimator: str | None

    def told(self, several_runs: bool = True) -> str:
        """RUN/ESTIMATOR, RUN, or ESTIMATOR where there is one run."""
        if self.estimator is None:
            return self.run
        return f"{self.run}/{self.estimator}" if several_runs else self.estimator


@dataclass(frozen=True)
class Course:
    """The difference along k: the last step of each window, the mean over lanes and its standard error (windows,).

    Standard errors are None with one lane, and where lanes are not paired.
    """

    ends: NDArray[np.int64]
    mean: Floats
    stderr: Floats | None


@dataclass(frozen=True)
class Pair:
    """first and last: the steps over which each lane's figure is averaged. p_holm: adjusted for all the pairs."""

    a: Item
    b: Item
    first: int
    last: int
    found: Difference
    course: Course
    p_holm: float | None = None


@dataclass(frozen=True)
class Comparison:
    """What `testbed compare` shows."""

    figure: str
    lanes: int
    several_runs: bool
    pairs: tuple[Pair, ...]
    notes: tuple[str, ...]

    def name(self, item: Item) -> str:
        """What it is called."""
        return item.told(self.several_runs)


def compare(
    runs: Sequence[RunFigures],
    *,
    figure: str = "trace_P",
    against: str | None = None,
    every: bool = False,
    whole: bool = False,
    unpaired: bool = False,
) -> Comparison:
    """Differences of a figure between the estimators of runs.

    ``against``: only with that ESTIMATOR or RUN/ESTIMATOR. ``every``: all pairs, where otherwise an estimator of
    several runs is compared only with itself. ``whole``: over all the steps of both, not the last quarter.
    ``unpaired``: lanes of different runs are independent. Raises UsageError where that cannot be.
    """
    kept = dict.fromkeys(figure for run in runs for figure in (*LANE_FIGURES, *run.lanes.whole))
    if figure not in kept:
        raise UsageError(f"--figure {figure}: no such figure; allowed: {', '.join(kept)}{did_you_mean(figure, kept)}")
    by_label = {run.label: run for run in runs}
    chosen = _chosen(runs, figure, against, every)
    notes = [] if unpaired else _pairing(runs)
    if unpaired:
        notes += _independence(runs)
    heavy = figure not in _NORMALISED and any(_not_ok(run, "finite mean", "finite variance") for run in runs)
    pairs = [_pair(by_label, a, b, figure, whole=whole, unpaired=unpaired, heavy=heavy) for a, b in chosen]
    adjusted = holm([pair.found.p_value for pair in pairs])
    pairs = [replace(pair, p_holm=p) for pair, p in zip(pairs, adjusted, strict=True)]
    made = Comparison(figure, runs[0].summary.lanes, len(runs) > 1, tuple(pairs), ())
    return replace(made, notes=(*notes, *_cautions(runs, figure), *_of_pairs(made, unsure=heavy)))


def _items(runs: Sequence[RunFigures], figure: str) -> list[Item]:
    """What has the figure. Raises UsageError where only some of the runs have it."""
    if figure in LANE_FIGURES:
        return [Item(run.label, name) for run in runs for name in run.lanes.figures]
    for run in runs:
        if figure not in run.lanes.whole:
            raise UsageError(f"--figure {figure}: {run.label} has none; allowed: a figure of all the runs")
    return [Item(run.label, None) for run in runs]


def _chosen(runs: Sequence[RunFigures], figure: str, against: str | None, every: bool) -> list[tuple[Item, Item]]:
    items = _items(runs, figure)
    pairs = list(combinations(items, 2))
    if against is not None:
        fixed = [item for item in items if against in (item.estimator, item.told())]
        names = list(dict.fromkeys(item.estimator or item.run for item in items))
        if len(runs) > 1:
            names += [item.told() for item in items if item.estimator is not None]
        if not fixed:
            hint = did_you_mean(against, names)
            raise UsageError(f"--against {against}: no such estimator; allowed: {', '.join(names)}{hint}")
        if len(fixed) == 1:
            pairs = [(item, fixed[0]) for item in items if item != fixed[0]]
        else:
            pairs = [(a, b) for a, b in pairs if a in fixed or b in fixed]
    elif len(runs) > 1 and not every:
        across = [(a, b) for a, b in pairs if a.run != b.run]
        pairs = [(a, b) for a, b in across if a.estimator == b.estimator] or across
    if not pairs:
        raise UsageError("nothing to compare with; allowed: several runs, or estimators of a run")
    return pairs


def _pair(
    runs: dict[str, RunFigures], a: Item, b: Item, figure: str, *, whole: bool, unpaired: bool, heavy: bool
) -> Pair:
    independent = unpaired and a.run != b.run
    ends, one, other = _on_common_windows(runs, a, b, figure)
    last = int(ends[-1])
    first = 1 if whole else first_settled(last)
    begins = np.concatenate([[1], ends[:-1] + 1])
    taken = begins >= first if np.any(begins >= first) else begins == begins[-1]
    lengths = (ends - begins + 1)[taken]
    lanes_a, lanes_b = (np.average(values[taken], axis=0, weights=lengths) for values in (one, other))
    if independent:
        found = welch(lanes_a, lanes_b)
    elif len(lanes_a) > 1:
        found = paired(lanes_a, lanes_b, heavy=heavy)
    else:
        found = batched(one[taken, 0], other[taken, 0])
    return Pair(a, b, int(begins[taken][0]), last, found, _course(ends, one, other, paired=not independent))


def _course(ends: NDArray[np.int64], one: Floats, other: Floats, *, paired: bool) -> Course:
    """Lanes where either has no figure are left out, window by window."""
    if not paired:
        return Course(ends, one.mean(axis=1) - other.mean(axis=1), None)
    d = one - other
    there = np.isfinite(d)
    count = there.sum(axis=1)
    mean = np.where(there, d, 0.0).sum(axis=1) / count
    if d.shape[1] == 1:
        return Course(ends, mean, None)
    spread = np.where(there, d - mean[:, None], 0.0)
    return Course(ends, mean, np.sqrt((spread**2).sum(axis=1) / (count * (count - 1.0))))


def _on_common_windows(
    runs: dict[str, RunFigures], a: Item, b: Item, figure: str
) -> tuple[NDArray[np.int64], Floats, Floats]:
    """The ends of the windows that two estimators share, and the figures of both over them, (windows, lanes)."""
    lanes = [runs[item.run].lanes for item in (a, b)]
    values = [
        of.whole[figure] if item.estimator is None else of.figures[item.estimator][figure]
        for of, item in zip(lanes, (a, b), strict=True)
    ]
    ends = [of.ends[: len(rows)] for of, rows in zip(lanes, values, strict=True)]
    common = np.intersect1d(ends[0], ends[1])
    if not len(common):
        raise UsageError(f"{a.told()}, {b.told()}: no step that both ran to its end")
    one, other = (_merged(rows, own, common) for rows, own in zip(values, ends, strict=True))
    return common, one, other


def _merged(values: Floats, ends: NDArray[np.int64], common: NDArray[np.int64]) -> Floats:
    """Means over the longer windows that end at ``common``."""
    if len(common) == len(ends):
        return values
    whole = int(np.searchsorted(ends, common[-1])) + 1
    lengths = np.diff(ends[:whole], prepend=0)
    begins = np.concatenate([[0], np.searchsorted(ends, common[:-1]) + 1])
    sums = np.add.reduceat(values[:whole] * lengths[:, None], begins, axis=0)
    merged: Floats = sums / np.diff(common, prepend=0)[:, None]
    return merged


def _pairing(runs: Sequence[RunFigures]) -> list[str]:
    """Raises UsageError where lanes of the runs cannot be paired."""
    first = runs[0]
    notes = []
    for run in runs[1:]:
        if differing := apart(first, run):
            raise UsageError(
                f"{first.label}, {run.label}: not the same lanes: {', '.join(differing)} differ"
                f"{'s' * (len(differing) == 1)}; allowed: the same, or --unpaired"
            )
        if differing := besides(first, run):
            notes.append(f"{first.label}, {run.label}: the noise is the same; what differs: {', '.join(differing)}")
    return notes


def _independence(runs: Sequence[RunFigures]) -> list[str]:
    notes = []
    if any(run.summary.lanes == 1 for run in runs):
        raise UsageError("--unpaired: a run has one lane; allowed: runs of two lanes or more")
    if len({run.summary.seed for run in runs}) < len(runs):
        notes.append("runs of one seed share random numbers: intervals for independent runs are most often too wide")
    for run in runs[1:]:
        if differing := [*apart(runs[0], run), *besides(runs[0], run)]:
            notes.append(f"{runs[0].label}, {run.label}: what differs: {', '.join(differing)}")
    return notes


def _cautions(runs: Sequence[RunFigures], figure: str) -> list[str]:
    """What the runs themselves say against an interval."""
    notes = []
    for run in runs:
        name = f"{run.label}: " if len(runs) > 1 else ""
        if run.summary.status != "complete":
            notes.append(f"{name}{run.summary.status} after {run.summary.completed_steps} of {run.summary.steps} steps")
        if figure not in _NORMALISED:
            notes += [
                f"{name}{check.text}"
                for check in run.summary.checks
                if not check.ok and check.name in ("finite mean", "finite variance")
            ]
        if figure in _BLURRED:
            notes += [f"{name}{c.text}" for c in run.summary.checks if not c.ok and c.name == "rounding"]
    return notes


def _of_pairs(made: Comparison, *, unsure: bool) -> list[str]:
    """What to know of single pairs; the same text once for all it holds of. ``unsure``: of the variance."""
    told: dict[str, list[str]] = {}
    for pair in made.pairs:
        names = f"{made.name(pair.a)} − {made.name(pair.b)}"
        if pair.found.left_out and pair.found.method != "batch means":
            told.setdefault(f"lanes without a finite figure, left out: {pair.found.left_out}", []).append(names)
        if pair.found.note is not None:
            told.setdefault(pair.found.note, []).append(names)
        elif pair.found.interval is None:
            told.setdefault("too few lanes for an interval", []).append(names)
    every = len(made.pairs)
    if unsure and any(pair.found.a_smaller is not None for pair in made.pairs):
        told["the share of lanes with a < b needs no variance"] = [""] * every
    return [note if len(names) == every else f"{', '.join(names)}: {note}" for note, names in told.items()]


def _not_ok(run: RunFigures, *names: str) -> bool:
    return any(check.name in names and not check.ok for check in run.summary.checks)
