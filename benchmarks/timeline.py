"""scenarios/timeline.toml: what swaps, a kill and a restart cost beside an estimator that is left alone."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from benchmarks.figures import Figures, Median, alternate, ratios
from benchmarks.summaries import changed, summary_of
from testbed.scenario import load_scenario

EXAMPLE = Path(__file__).parents[1] / "scenarios" / "timeline.toml"
LEFT_ALONE = "twin"
_WATCHED = 10
_LOST = ("kill", "restart")


def run(*, quick: bool) -> Figures:
    given = load_scenario(EXAMPLE)
    events = [event.model_dump(mode="json", exclude_none=True, by_alias=True) for event in given.events]
    undisturbed = [event for event in events if event["action"] not in _LOST]
    cases = {"real": given, "virtual": changed(given, clock=None)}
    cases["nobody lost"] = changed(given, clock=None, events=undisturbed)
    found = alternate(1 if quick else 3, {name: lambda case=case: summary_of(case) for name, case in cases.items()})
    figures = Figures("timeline")
    for number, event in enumerate(events):
        if event["action"] != "set":
            figures.rows.append(_row(number, event, found["real"], found["virtual"]))
    rates = {name: [summary["timing"]["steps_per_s"] for summary in found[name]] for name in ("virtual", "nobody lost")}
    figures.tables["virtual time"] = [
        {"case": name, "steps/s": Median.of(rates[name]), "ratio": ratios(rates[name], rates["nobody lost"])}
        for name in rates
    ]
    figures.notes.append(
        "late: the largest time from t_k to publication of ten estimates from there on, ms; other: of the estimator "
        f"'{LEFT_ALONE}' that is left alone, in the same steps; on time: steps until ten in a row are published within "
        "the period; held: how long virtual time stood still, or a role was down; median (lowest … highest)"
    )
    return figures


def _row(number: int, event: dict[str, Any], real: list[Any], virtual: list[Any]) -> dict[str, Any]:
    entries = [next(e for e in summary["events"] if e["number"] == number) for summary in real]
    row: dict[str, Any] = {"event": f"{event['action']} {event.get('role') or event['estimator']}"}
    row["hand-over"] = event.get("handover") or ("promoted" if event["action"] == "swap" else "")
    row["put off, steps"] = Median.of([entry["step"] - event["at"] for entry in entries])
    name = event.get("name") or event.get("estimator") or "active"
    both = [(summary, entry) for summary, entry in zip(real, entries, strict=True) if entry["ok"]]
    row["not done"] = len(entries) - len(both)
    if not both:
        return row
    row["late, ms"] = Median.of([_late(summary, name, entry["step"]) for summary, entry in both])
    row["other, ms"] = Median.of([_late(summary, LEFT_ALONE, entry["step"]) for summary, entry in both])
    row["on time, steps"] = Median.of([_until_on_time(summary, name, entry["step"]) for summary, entry in both])
    if event["action"] in _LOST:
        place = [e["action"] for e in real[0]["events"] if e["action"] in _LOST].index(event["action"])
        row["down, ms, real"] = Median.of([summary["recovered"][place]["down_ms"] for summary in real])
        row["held, ms, virtual"] = Median.of([summary["recovered"][place]["down_ms"] for summary in virtual])
    else:
        downs = [[down for down in summary["timing"]["swaps"] if down["step"] == event["at"]] for summary in virtual]
        row["held, ms, virtual"] = Median.of([down[0]["ms"] for down in downs])
    return row


def _late(summary: dict[str, Any], name: str, step: int) -> float:
    times = summary["realtime"]["stages"][f"estimate/{name}"]["published_us"][step - 1 : step - 1 + _WATCHED]
    return float(max(time for time in times if time is not None)) / 1e3


def _until_on_time(summary: dict[str, Any], name: str, step: int) -> int:
    times = summary["realtime"]["stages"][f"estimate/{name}"]["published_us"][step - 1 :]
    deadline = summary["realtime"]["deadline_us"]
    late = [time is not None and time > deadline for time in times]
    return next((k for k in range(len(late)) if not any(late[k : k + _WATCHED])), len(late))
