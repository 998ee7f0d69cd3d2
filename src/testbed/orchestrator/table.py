"""What `testbed run` prints at its end."""

from __future__ import annotations

from pathlib import Path

from rich.console import Group, RenderableType
from rich.table import Table
from rich.text import Text

from testbed.orchestrator.realtime_figures import RealTime
from testbed.orchestrator.report import text
from testbed.orchestrator.report.derived import common_band, settled
from testbed.orchestrator.summary import CostFigures, Summary


def end_table(summary: Summary, directory: Path) -> RenderableType:
    """The figures of a run for a terminal of 80 columns or more; no name in it is read as markup.

    Args:
        summary: the figures of the run.
        directory: where its files are.
    """
    parts: list[RenderableType] = [_headline(summary)]
    if summary.estimators:
        parts += [_estimators(summary), *_notes(summary)]
    if summary.cost is not None and summary.completed_steps:
        parts.append(_cost(summary, summary.cost))
    if summary.links:
        parts.append(_links(summary))
    if summary.realtime is not None:
        parts += _realtime(summary.realtime)
    for event in summary.events:
        origin = "" if event.by == "timeline" else f" ({event.origin})"
        parts.append(_line(f"step {event.step}", f"{event.text}{origin}", "dim" if event.ok else "bold yellow"))
    parts += [_line(f"step {lost.step}", lost.text, "bold yellow") for lost in summary.recovered]
    parts += [_line("not ok", f"{check.name}: {check.text}", "bold yellow") for check in summary.checks if not check.ok]
    for role, reasons in summary.rejected.items():
        counts = ", ".join(f"{count} × {reason}" for reason, count in reasons.items())
        parts.append(_line("rejected", f"{role}: {counts}", "bold yellow"))
    parts.append(Text(f"Files: {directory}", overflow="fold"))
    return Group(*parts)


def _headline(summary: Summary) -> Text:
    size = f"{text.plural(summary.lanes, 'lane')}, seed {summary.seed}"
    if summary.timing.wall_s is not None:
        size += f", {text.number(summary.timing.wall_s, 3)} s"
    if summary.status == "complete":
        return Text.assemble((summary.name, "bold"), f": {text.plural(summary.completed_steps, 'step')}, {size}")
    end = f"{summary.status} after {summary.completed_steps} of {text.plural(summary.steps, 'step')}"
    return Text.assemble((summary.name, "bold"), ": ", (end, "bold red"), f", {size}\n", summary.reason or "")


def _estimators(summary: Summary) -> Table:
    band = common_band(summary)
    table = _table("estimator", "ACKs", "steps", "tr P", "‖x−x̂‖²", f"NEES {text.band(band)}" if band else "NEES [band]")
    for name, figures in summary.estimators.items():
        tail = settled(figures, summary.completed_steps)
        cells = [name, figures.acks]
        if tail is None:
            cells += ["none", *[text.ABSENT] * 3]
        else:
            own_band = "" if band else f" {text.band(figures.nees_band_95)}"
            cells += [
                text.steps(tail.first, tail.last),
                text.plus_minus(tail.trace_P, tail.trace_P_stderr),
                text.plus_minus(tail.squared_error, tail.squared_error_stderr),
                f"{text.number(tail.nees, 3)}{own_band}",
            ]
        table.add_row(*(Text(cell) for cell in cells))
    return table


def _notes(summary: Summary) -> list[RenderableType]:
    notes: list[RenderableType] = [
        Text("Means over the last quarter of an estimator's steps, ± standard error.", "dim")
    ]
    for name, figures in summary.estimators.items():
        tail = settled(figures, summary.completed_steps)
        if tail is not None and tail.missing:
            notes.append(_line("note", f"{name} has no finite tr P at {tail.missing} of its steps", "bold yellow"))
    return notes


def _cost(summary: Summary, cost: CostFigures) -> Text:
    line = f"cost: {text.plus_minus(cost.a_step, cost.a_step_stderr)} a step, "
    line += f"{text.plus_minus(cost.total, cost.total_stderr)} in all"
    controller = summary.controller
    if controller is None:
        return Text(line)
    saturated = controller.counters.get("saturated", 0)
    at_limits = f", {text.count(saturated)} at a limit" if saturated else ""
    return Text(f"{line} ({controller.kind} on {controller.estimator}{at_limits})")


def _links(summary: Summary) -> Table:
    late = any(link.late for link in summary.links.values())
    table = _table("link", "sent", "dropped", *(["late"] if late else []), "loss rate")
    for name, link in summary.links.items():
        counts = [link.sent, link.dropped, *([link.late] if late else [])]
        cells = [name, *map(text.count, counts), text.number(link.loss_rate)]
        table.add_row(*(Text(cell) for cell in cells))
    return table


def _realtime(realtime: RealTime) -> list[RenderableType]:
    table = _table("µs after t_k", "50 %", "90 %", "99 %", "largest", "missed", "absent")
    stages = {topic: stage for topic, stage in realtime.stages.items() if topic.startswith(("control/sent", "estim"))}
    for topic, stage in stages.items():
        values = (stage.published.p50, stage.published.p90, stage.published.p99, stage.published.max)
        cells = [text.ABSENT if value is None else text.count(round(value)) for value in values]
        cells += [text.count(stage.missed), text.count(stage.absent)]
        table.add_row(*(Text(cell) for cell in (topic.removeprefix("estimate/"), *cells)))
    deadline = text.count(round(realtime.deadline_us))
    note = f"Deadline {deadline} µs after t_k, when u of the step was due; {realtime.deadlines}."
    return [table, Text(note, "dim")]


def _table(first: str, *others: str) -> Table:
    table = Table(box=None, pad_edge=False, header_style="bold", padding=(0, 2, 0, 0))
    table.add_column(Text(first), overflow="fold")
    for other in others:
        table.add_column(Text(other), justify="right", overflow="fold")
    return table


def _line(label: str, content: str, style: str) -> Text:
    return Text.assemble((f"{label}: ", style), content)
