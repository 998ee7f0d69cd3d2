"""What an estimator of a scenario is told late, and how far it goes back for that."""

from __future__ import annotations

from testbed.scenario import EstimatorSpec, Scenario

BUFFER = 20
"""Steps that an estimator can go back, unless its table says otherwise, where observations or ACKs can be late."""


def acks_of(scenario: Scenario, spec: EstimatorSpec) -> str:
    """Where an estimator's ACKs come from: "none", "perfect" or "link"."""
    return spec.acks if spec.acks is not None else scenario.links.ack.mode


def buffer_of(scenario: Scenario, spec: EstimatorSpec) -> int:
    """Steps that an estimator can go back: as its table says, or as many as are of use."""
    if spec.buffer is not None:
        return spec.buffer
    late = scenario.takes_time("observation")
    late = late or (acks_of(scenario, spec) == "link" and scenario.takes_time("ack"))
    return BUFFER if late else 0


def largest_buffer(scenario: Scenario) -> int:
    """That of the estimator that goes back farthest; without estimators, of one whose table says nothing."""
    later = [plan.spec for plan in scenario.swaps if plan.spec is not None]
    specs = [*scenario.estimators, *later] or [EstimatorSpec(name="any")]
    return max(buffer_of(scenario, spec) for spec in specs)
