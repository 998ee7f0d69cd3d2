"""Whether a controller is the optimal one for its cost, and if not, why not."""

from __future__ import annotations

from testbed.estimator.buffers import acks_of
from testbed.estimator.registry import model_of
from testbed.estimator.service import spec_of
from testbed.scenario import LqgInput, Scenario
from testbed.scenario.plant_events import PlantEvent
from testbed.scenario.services import Planned

WITH_ACKS = frozenset({"kfio", "oe", "oe-exact", "aoe", "gpb", "gpb1", "gpb2", "imm", "lmmse", "ff", "kf"})
"""Estimators that with every ACK in time are one and the same: the conditional mean."""


def statement(scenario: Scenario) -> str | None:
    """One line on an LQG controller; None for any other."""
    source = scenario.input
    if not isinstance(source, LqgInput):
        return None
    reasons = shortcomings(scenario, source)
    if not reasons:
        horizon = "of this run" if source.horizon == "run" else "a step of an endless run"
        return f"optimal: no controller has a smaller expected cost {horizon}"
    return f"not optimal: {'; '.join(reasons)}"


def shortcomings(scenario: Scenario, source: LqgInput) -> list[str]:
    """What keeps the gain from being optimal."""
    model, spec = model_of(scenario), spec_of(scenario, source.estimator)
    acks = acks_of(scenario, spec)
    lossy = not model.control.never_loses
    out = []
    if lossy and acks == "none":
        out.append(
            f"{spec.name} gets no ACKs, so that the control moves its covariance and the separation principle fails; "
            "the gain is the one with ACKs (certainty equivalence)"
        )
    if lossy and acks == "link":
        out.append(f"{spec.name} gets some ACKs only, and the separation principle needs all")
    if spec.kind not in WITH_ACKS:
        out.append(f"the x̂ of {spec.kind} is not known to be the conditional mean")
    if model.control.as_chain is None:
        out.append("the losses have a hidden state, and the gain is for independent ones of the same rate")
    if model.holds:
        out.append("the actuator holds, and the gain is for one that applies zero")
    if source.low is not None or source.high is not None:
        out.append("the input has limits")
    if any(isinstance(event, PlantEvent) for event in scenario.events):
        out.append("the plant drifts away from its model")
    if scenario.uncertainty is not None:
        out.append("the plant departs from its model")
    unlike = [plan.step for plan in scenario.swaps if _replaces(plan, spec.name) and plan.handover != "full"]
    if unlike:
        out.append(f"{spec.name} is swapped at step {unlike[0]}, and the new one does not know all that came before")
    if scenario.changes_of("control"):
        out.append("the losses of control change, and the gain is for those at the beginning")
    return out


def _replaces(plan: Planned, name: str) -> bool:
    return plan.replaces and plan.name == name
