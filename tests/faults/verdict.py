"""What must hold of a run with faults, from what the words mean and from the run without them."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

from faults.observed import Observed
from testbed.orchestrator.summary import EstimatorFigures, Summary

Table = dict[str, Any]
ENDS = ("kill", "restart")
"""Events that end a process."""
INCIDENTAL = {"timing", "recovered", "repeated", "rejected"}
"""What faults may change in a summary."""


@dataclass
class Outcome:
    """killed: the roles that died, in order. messages: how many were delivered. log: what the faults did."""

    summary: Summary
    observed: Observed
    files: dict[str, bytes]
    messages: int
    killed: list[str]
    log: list[str]

    @property
    def unnoticed(self) -> list[str]:
        """Roles that died so late that nobody started them anew: what they had to report is lost with them."""
        again = [lost.role for lost in self.summary.recovered]
        return sorted(role for role in set(self.killed) if self.killed.count(role) > again.count(role))

    def unlike(self, again: Outcome) -> list[str]:
        """In what a second run with the same faults differs."""
        figures, others = (determined(outcome.summary, {"timing"}) for outcome in (self, again))
        for figure in (figures, others):
            for entry in figure["recovered"]:
                del entry["down_ms"]
        out = [f"replayed, {key} differs" for key in figures if figures[key] != others[key]]
        if self.log != again.log:
            out.append("replayed, the faults did something else")
        if self.observed.recorded != again.observed.recorded or self.files != again.files:
            out.append("replayed, what was recorded differs")
        return out


def determined(summary: Summary, but: set[str]) -> Table:
    table = summary.model_dump(exclude=but)
    if "events" in table:
        table["events"] = [event for event in table["events"] if event["action"] not in ENDS]
    return table


def findings(plain: Outcome, disturbed: Outcome, recovery: Table, ended: Sequence[str] = ()) -> list[str]:
    """What is wrong; nothing where all is as it should be. ended: the roles that the timeline ends."""
    summary = disturbed.summary
    out = [*_books(summary), *_finite(summary), *_counted(summary, disturbed.observed)]
    if plain.summary.status != "complete":
        return [*out, f"without faults it is {plain.summary.status}: {plain.summary.reason}"]
    if summary.status == "complete":
        return [*out, *_same(plain, disturbed)]
    return [*out, *_explained(disturbed, ended, recovery), *_same_beginning(plain, disturbed)]


def _last(figures: EstimatorFigures, summary: Summary) -> int:
    """The last complete step at which an estimator was there."""
    return summary.completed_steps if figures.until is None else min(figures.until, summary.completed_steps)


def _books(summary: Summary) -> Iterator[str]:
    for name, link in summary.links.items():
        if link.sent + link.duplicated != link.delivered + link.dropped + link.in_flight:
            yield f"link {name}: {link.sent} sent, {link.duplicated} copies; what became of them does not add up"
        if link.dropped != sum(link.causes.values()):
            yield f"link {name}: {link.dropped} dropped, by cause {link.causes}"
        if summary.status == "complete" and link.sent != summary.steps * summary.lanes:
            yield f"link {name}: {link.sent} sent in {summary.steps} steps of {summary.lanes} lanes"


def _finite(summary: Summary) -> Iterator[str]:
    """A figure that is not finite is null in a summary: each step of an estimator that was there has its figures."""
    for name, figures in summary.estimators.items():
        last = _last(figures, summary)
        for what in ("trace_P_mean", "squared_error_mean"):
            values = getattr(figures, what)[max(0, figures.since - 1) : last]
            if any(value is None or not math.isfinite(value) for value in values):
                yield f"{name}: {what} has a step without a number"
    if summary.bounds is not None and any(value is None for value in summary.bounds.lower_mean):
        yield "the lower bound has a step without a number"


def _counted(summary: Summary, observed: Observed) -> Iterator[str]:
    """Every step and block of lanes has exactly one estimate of each estimator that is there then."""
    lanes = sorted({lane for _, _, lane in observed.estimates})
    for name, figures in summary.estimators.items():
        for step in range(max(1, figures.since), _last(figures, summary) + 1):
            for lane in lanes:
                times = observed.estimates[name, step, lane]
                if times != 1:
                    yield f"{name} has {times} estimates of step {step} from lane {lane} on"
    for key, times in observed.times.items():
        if times != 1:
            yield f"{key} is {times} times in the recording"


def _same(plain: Outcome, disturbed: Outcome) -> Iterator[str]:
    """Equal to the bit: figures, recording, figures by lane."""
    but = INCIDENTAL | ({"events"} if any(not event.ok for event in disturbed.summary.events) else set())
    wanted, found = determined(plain.summary, but), determined(disturbed.summary, but)
    for role in disturbed.unnoticed:
        for table in (wanted, found):
            _without_report(table, role)
    for key in wanted:
        if wanted[key] != found[key]:
            yield f"{key} differs: {_where(wanted[key], found[key])}"
    if plain.observed.recorded != disturbed.observed.recorded:
        keys = plain.observed.recorded.keys() ^ disturbed.observed.recorded.keys()
        yield f"the recording differs: only in one {sorted(keys)[:5]}"
    if plain.observed.estimates != disturbed.observed.estimates:
        yield "the collector took other estimates"
    if plain.files != disturbed.files:
        yield "the files differ"


def _without_report(table: Table, role: str) -> None:
    """Leave out what a role says of itself at its end."""
    kind, _, name = role.partition(".")
    if kind == "estimator":
        table["estimators"].get(name.partition(".")[0], {}).pop("counters", None)
    elif kind == "link":
        table["links"].pop(name, None)
        table["checks"] = [check for check in table["checks"] if check["name"] != "books"]
    elif kind == "controller":
        table["controller"] = None


def _explained(outcome: Outcome, ended: Sequence[str], recovery: Table) -> Iterator[str]:
    """A run that has failed says who was lost, and could not go on."""
    summary = outcome.summary
    if any(summary.reason == f"{role.replace('.', ' ')} did not report" for role in outcome.unnoticed):
        return
    killed = [*outcome.killed, *ended]
    role = next((role for role in killed if summary.reason is not None and summary.reason.startswith(role)), None)
    if summary.status != "failed" or role is None:
        yield f"{summary.status}: {summary.reason}"
    elif recovery.get("policy") != "fail" and _restarts(summary, role) < recovery["restarts"]:
        yield f"failed although {role} could be started anew: {summary.reason}"


def _restarts(summary: Summary, role: str) -> int:
    return sum(lost.role == role for lost in summary.recovered)


def _same_beginning(plain: Outcome, disturbed: Outcome) -> Iterator[str]:
    """A run that has failed is the run without faults up to there."""
    steps = disturbed.summary.completed_steps
    for name, figures in disturbed.summary.estimators.items():
        if name not in plain.summary.estimators:
            yield f"{name} is not in the run without faults"
            continue
        for what, values in figures:
            if isinstance(values, tuple) and what.endswith(("_mean", "_stderr")):
                whole = getattr(plain.summary.estimators[name], what)
                if values != whole[:steps]:
                    yield f"{name}: {what} differs before the end"


def _where(a: object, b: object, at: str = "") -> str:
    """The first place in which two tables differ."""
    if isinstance(a, dict) and isinstance(b, dict):
        for key in [*a, *(key for key in b if key not in a)]:
            if key not in a or key not in b:
                return f"{at}.{key} is in one only"
            if a[key] != b[key]:
                return _where(a[key], b[key], f"{at}.{key}")
    if isinstance(a, list | tuple) and isinstance(b, list | tuple):
        for i, (x, y) in enumerate(zip(a, b, strict=False)):
            if x != y:
                return _where(x, y, f"{at}[{i}]")
        return f"{at} has {len(a)} and {len(b)} entries"
    return f"{at}: {a!r} and {b!r}"
