"""A run that goes on after its orchestrator has died: what it was, and where it begins again.

Its commands have become events of the scenario, at the steps at which they took effect; what an event does after the
checkpoint it does again. Where a condition is looked at, the run begins anew: what a condition has seen is in no
checkpoint. The results are the same either way.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from pydantic import TypeAdapter, ValidationError

from testbed.errors import UsageError
from testbed.estimator.service import builder, role_of
from testbed.orchestrator.journal import Found, read
from testbed.orchestrator.recovery import Checkpoint
from testbed.orchestrator.roles import RoleSpec
from testbed.orchestrator.services import Origin, Turn
from testbed.orchestrator.summary import Downtime, Happened, Recovered, read_summary
from testbed.orchestrator.timeline import happened
from testbed.scenario import EstimatorSpec, Scenario, parse_scenario, to_dict
from testbed.scenario.events import Event
from testbed.wire.messages import Status
from testbed.wire.node import ORCHESTRATOR

if TYPE_CHECKING:
    from testbed.orchestrator.conductor import Conductor

FOLDER, SUMMARY = "journal", "summary.json"
_ENDED = {"failed": "failed", "interrupted": "was interrupted"}


@dataclass(frozen=True)
class Resumed:
    """A run that was begun. given: its scenario as it was; scenario: with what was commanded.

    origins: of the events that were commanded, by their place among all. refused: what was commanded and not done.
    external: the roles that somebody starts by hand. before: each time that it was resumed before. lost: what of the
    journal is damaged, a line each. anew: why it begins anew; empty: it goes on after ``step``.
    """

    run: str
    given: Scenario
    scenario: Scenario
    step: int
    found: Found
    origins: dict[int, Origin]
    refused: tuple[Happened, ...]
    external: tuple[str, ...]
    before: tuple[Recovered, ...]
    lost: tuple[str, ...]
    anew: str

    @property
    def record(self) -> Recovered:
        """What the summary says of it."""
        done = _last_step(self.found)
        return Recovered(role=ORCHESTRATOR, how="did not finish", step=done, policy="restart", begin=self.step)


def facts_of(conductor: Conductor, step: int) -> dict[str, Any]:
    """What the orchestrator knows, beside figures and states, as it was after a completed step."""
    services = conductor.services
    turns = {
        name: [
            {"first": t.first, "role": t.role, "spec": t.spec.model_dump(mode="json"), "carried": t.carried}
            for t in of_name
            if t.first <= step
        ]
        for name, of_name in services.turns.items()
    }
    return {
        "turns": {name: of_name for name, of_name in turns.items() if of_name},
        "last": {name: services.last[name] for name, of_name in turns.items() if of_name},
        "happened": [_json(entry) for entry in services.happened if entry.step <= step],
        "others": [_json(entry) for entry in conductor.timeline.others if entry.step <= step],
        "downtimes": [_json(entry) for entry in services.downtimes if entry.step <= step],
        "recovered": [_json(entry) for entry in conductor.recovery.happened],
    }


def resumed(folder: Path) -> Resumed:
    """What a run's folder says of a run that was not finished. Raises UsageError where there is none."""
    path = folder / FOLDER
    if not path.is_dir():
        raise UsageError(f"{folder}: {_why_none(folder)}; allowed: the folder of a run that was not finished")
    found = read(path)
    try:
        given = parse_scenario(found.begin["scenario"], source=f"{path}: scenario")
        run = str(found.begin["run"])
        commands = {int(note["number"]): note for note in found.notes if "command" in note}
        refused = [Happened.model_validate(note["refused"]) for note in found.notes if "refused" in note]
        decided = commands.keys() | {entry.number for entry in refused}
        undecided = [note for note in found.notes if "ordered" in note and note["number"] not in decided]
        for note in undecided:
            if note["timed"]:
                commands[note["number"]] = {"command": note["ordered"], "by": "command", "when": None, "true": None}
            else:
                refused.append(_not_done(note, _last_step(found)))
        origins = {
            len(given.events) + place: Origin(note["by"], number, note["when"], note["true"])
            for place, (number, note) in enumerate(sorted(commands.items()))
        }
        tables = [note["command"] for _, note in sorted(commands.items())]
        external = tuple(map(str, found.begin["external"]))
        before = tuple(Recovered.model_validate(note["resumed"]) for note in found.notes if "resumed" in note)
    except (KeyError, TypeError, ValueError) as error:
        raise UsageError(f"{path}: not the journal of a run: {' '.join(str(error).split())}") from None
    if given.clock.real:
        raise UsageError(
            f"{folder}: its run keeps real time, and what was due meanwhile cannot be made up; allowed: to begin anew"
        )
    scenario = _with_events(given, tables, path)
    step, anew = 0, ""
    if any(not event.timed for event in given.events):
        anew = "what its conditions have seen is in no checkpoint"
    elif found.checkpoint is None:
        anew = "there is no checkpoint of it"
    else:
        step = found.checkpoint.step
    return Resumed(run, given, scenario, step, found, origins, tuple(refused), external, before, found.lost, anew)


def _not_done(note: dict[str, Any], step: int) -> Happened:
    """Of an order that was not decided yet when the run ended, nobody knows the step at which it would have been."""
    event: Event = TypeAdapter(Event).validate_python(note["ordered"])
    when = getattr(event, "when", None)
    origin = Origin("condition" if when else "command", int(note["number"]), when)
    reason = "the run was cut off before it was decided"
    return happened(event, origin, step).model_copy(update={"ok": False, "reason": reason})


def _last_step(found: Found) -> int:
    """Up to which there are figures."""
    return found.figures[-1].to if found.figures else 0


def _why_none(folder: Path) -> str:
    try:
        status = read_summary(folder / SUMMARY).status
    except (OSError, UsageError):
        return "no run to be resumed"
    return "its run is complete" if status == "complete" else f"its run {_ENDED[status]}, and kept no journal"


def _with_events(given: Scenario, tables: list[dict[str, Any]], path: Path) -> Scenario:
    if not tables:
        return given
    data = to_dict(given)
    try:
        return Scenario.model_validate({**data, "events": [*data.get("events", ()), *tables]})
    except ValidationError as error:
        raise UsageError(f"{path}: what was commanded does not fit the scenario: {error}") from None


def roles_at(roles: list[RoleSpec], begun: Resumed) -> list[RoleSpec]:
    """The roles of a run where it goes on."""
    if not begun.step:
        return roles
    assert begun.found.checkpoint is not None
    others = [role for role in roles if not role.name.startswith(role_of(""))]
    return others + [
        _service(name, turn)
        for name, turns in _turns(begun.found.checkpoint.facts).items()
        if begun.found.checkpoint.facts["last"][name] >= begun.step
        for turn in turns[-1:]
    ]


def services_at(begun: Resumed) -> dict[str, EstimatorSpec]:
    """The estimators of the roles that joined on the way, where the run goes on."""
    if not begun.step:
        return {}
    assert begun.found.checkpoint is not None
    turns = [turns[-1] for turns in _turns(begun.found.checkpoint.facts).values()]
    return {turn.role: turn.spec for turn in turns if turn.first > 1}


def go_on(conductor: Conductor, begun: Resumed) -> None:
    """Let a new conductor know what the old one knew."""
    timeline, services, step = conductor.timeline, conductor.services, begun.step
    numbers = [origin.number for origin in begun.origins.values()]
    numbers += [entry.number for entry in begun.refused if entry.number is not None]
    timeline.name_origins(begun.origins, 1 + max(numbers, default=-1))
    services.pending = [
        replace(entry, origin=begun.origins.get(entry.origin.number, entry.origin)) for entry in services.pending
    ]
    recovered = conductor.recovery.happened
    if not step:
        recovered += (*begun.before, begun.record)
        timeline.others += begun.refused
        return
    checkpoint = begun.found.checkpoint
    assert checkpoint is not None
    facts = checkpoint.facts
    conductor.collector.resume(step, checkpoint.collector, (part.content for part in begun.found.figures))
    services.turns, services.last = _turns(facts), dict(facts["last"])
    done = [entry for entry in services.pending if entry.step is not None and entry.step <= step]
    refused = {h["number"] for h in facts["happened"] if not h.get("ok", True)}
    services.made = [(entry.plan.event, entry.step or 0) for entry in done if entry.origin.number not in refused]
    services.pending = [entry for entry in services.pending if entry not in done]
    services.happened = [Happened.model_validate(entry) for entry in facts["happened"]]
    services.downtimes = [Downtime.model_validate(entry) for entry in facts["downtimes"]]
    services.count_again()
    timeline.others += [Happened.model_validate(entry) for entry in facts["others"]]
    known = {entry.number for entry in (*timeline.others, *services.happened) if not entry.ok}
    timeline.others += [entry for entry in begun.refused if entry.number not in known]
    timeline.begin_after(step)
    entries = [Recovered.model_validate(entry) for entry in facts["recovered"]]
    recovered += (*(entry for entry in entries if entry.role != ORCHESTRATOR), *begun.before, begun.record)
    states: dict[str, dict[int, bytes]] = {}
    for (role, lane), data in checkpoint.states.items():
        states.setdefault(role, {})[lane] = data
    conductor.recovery.checkpoint = Checkpoint(step, states)
    conductor.begin_after(step, {role: Status.model_validate_json(word) for role, word in facts["reports"].items()})


def _turns(facts: Any) -> dict[str, list[Turn]]:
    return {
        name: [Turn(t["first"], t["role"], EstimatorSpec.model_validate(t["spec"]), t["carried"]) for t in turns]
        for name, turns in facts["turns"].items()
    }


def _service(name: str, turn: Turn) -> RoleSpec:
    """An estimator's service as it was started: the one of the scenario, or one that joined later."""
    base = turn.spec.name
    if turn.role == role_of(base) and turn.first == 1:
        return RoleSpec(turn.role, builder(base), "testbed.estimator", ("--name", base))
    arguments = ("--name", base, "--role", turn.role, "--spec", turn.spec.model_dump_json())
    return RoleSpec(turn.role, builder(base, turn.spec), "testbed.estimator", arguments)


def _json(entry: Any) -> Any:
    return entry.model_dump(mode="json", exclude_none=True)
