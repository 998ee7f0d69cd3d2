"""What a swap cost: the error after it against a twin: of the new kind all along, and never swapped."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from testbed.estimator.buffers import acks_of
from testbed.orchestrator.preflight import settings_of
from testbed.orchestrator.services import Turn
from testbed.orchestrator.summary import EstimatorFigures, Happened, Transient
from testbed.scenario import EstimatorSpec, Scenario

SETTLED = 0.01


def with_transients(
    events: Sequence[Happened],
    scenario: Scenario,
    turns: Mapping[str, Sequence[Turn]],
    figures: Mapping[str, EstimatorFigures],
) -> list[Happened]:
    """The events, the swaps among them with their transient where the run has a twin."""
    out = []
    for event in events:
        if event.action == "swap" and event.ok and event.estimator is not None:
            changes = [turn.first for turn in turns[event.estimator] if turn.first > event.step]
            new = next(turn.spec for turn in turns[event.estimator] if turn.first == event.step)
            twin = _twin(new, scenario, turns)
            if twin is not None:
                end = min(changes, default=scenario.steps + 1) - 1
                found = transient(twin, event.step, end, figures[event.estimator], figures[twin])
                event = event.model_copy(update={"transient": found})
        out.append(event)
    return out


def transient(name: str, first: int, last: int, swapped: EstimatorFigures, twin: EstimatorFigures) -> Transient | None:
    """Of the steps first … last, as far as both have figures; None where they have none."""
    differences: list[tuple[int, float, float]] = []
    for step in range(first, min(last, len(twin.squared_error_mean)) + 1):
        own, other = swapped.squared_error_mean[step - 1], twin.squared_error_mean[step - 1]
        if own is None or other is None:
            break
        differences.append((step, own - other, other))
    if not differences:
        return None
    settled = None
    for step, difference, other in reversed(differences):
        if abs(difference) > SETTLED * other:
            break
        settled = step
    return Transient(
        twin=name,
        last=differences[-1][0],
        mean=sum(difference for _, difference, _ in differences) / len(differences),
        largest=max(abs(difference) for _, difference, _ in differences),
        settled=settled,
    )


def _twin(new: EstimatorSpec, scenario: Scenario, turns: Mapping[str, Sequence[Turn]]) -> str | None:
    """The first estimator with the same kind, options and ACKs that was there from the beginning and never swapped."""
    wanted = settings_of(new), acks_of(scenario, new)
    for name, taken in turns.items():
        alone = len(taken) == 1 and taken[0].first == 1 and name != new.name
        if alone and (settings_of(taken[0].spec), acks_of(scenario, taken[0].spec)) == wanted:
            return name
    return None
