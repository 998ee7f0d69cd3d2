"""One seed: a scenario, its timeline, faults, the run without them, the run with them, and what is wrong with it."""

from __future__ import annotations

import random
from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

from faults.disturbances import Disturbance, disturbances
from faults.network import DisturbedNetwork
from faults.observed import Observed, files_of
from faults.scenarios import scenario_table
from faults.timeline import ends, events
from faults.verdict import Outcome, findings
from orchestrator.runs import run
from testbed.scenario import parse_scenario

Table = dict[str, Any]


@dataclass
class Trial:
    """table: the scenario; recovery: its table [recovery]; ends: events that end processes; faults: what else happens.

    schedule: the order of delivery; None: over processes.
    """

    seed: int
    table: Table
    recovery: Table
    schedule: int | None
    faults: list[Any] = field(default_factory=list)
    ends: list[Table] = field(default_factory=list)
    plain: Outcome | None = None
    disturbed: Outcome | None = None
    problems: list[str] = field(default_factory=list)


def trial(seed: int, folder: Path, *, twice: bool = True) -> Trial:
    """Make it, run it, judge it. twice: a second time with the same faults, which must give the same bits."""
    draw = random.Random(seed)
    table = scenario_table(draw)
    table["events"] = events(draw, table)
    made = Trial(seed, table, _recovery(draw, table), schedule=draw.randrange(2**31))
    made.plain = once(table, folder / "plain")
    made.faults = disturbances(draw, made.plain.messages)
    made.ends = ends(draw, table)
    with_recovery = {**table, "recovery": made.recovery, "events": [*table["events"], *made.ends]}
    disturbed = partial(once, with_recovery, schedule=made.schedule, faults=made.faults)
    made.disturbed = disturbed(folder / "disturbed")
    plain = made.plain
    refused = [event for event in made.disturbed.summary.events if not event.ok]
    if refused != [event for event in plain.summary.events if not event.ok]:
        plain = once(_without(table, made.disturbed), folder / "without")
    made.problems = findings(plain, made.disturbed, made.recovery, [event["role"] for event in made.ends])
    if twice:
        made.problems += made.disturbed.unlike(disturbed(folder / "again"))
    return made


def once(table: Table, folder: Path, *, schedule: int | None = None, faults: Sequence[Disturbance] = ()) -> Outcome:
    networks: list[DisturbedNetwork] = []

    def network(seed: int | None = None, *, timed: bool = False) -> DisturbedNetwork:
        networks.append(DisturbedNetwork(seed, timed=timed, disturbances=faults))
        return networks[-1]

    observed = Observed()
    with observed.watching():
        summary = run(parse_scenario(table), folder, schedule, network)  # type: ignore[arg-type]
    return Outcome(summary, observed, files_of(folder), networks[0].delivered, networks[0].killed, networks[0].log)


def _recovery(draw: random.Random, table: Table) -> Table:
    recovery: Table = {"every": draw.choice((3, 4, 5, 7, 10, 20, 50)), "restarts": draw.choice((1000, 1000, 1000, 2))}
    if draw.random() < 0.15:
        recovery["policy"] = draw.choice(("fail", "restart"))
    return recovery


def _without(table: Table, outcome: Outcome) -> Table:
    """The scenario without the events that were not done."""
    refused = {
        (event.step, event.action, event.estimator, event.name) for event in outcome.summary.events if not event.ok
    }
    kept = [
        event
        for event in table["events"]
        if (max(1, event.get("at", 0)), event["action"], event.get("estimator"), event.get("name")) not in refused
    ]
    return {**table, "events": kept}
