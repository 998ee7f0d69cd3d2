"""What can be known to be wrong before anything starts."""

from __future__ import annotations

import inspect
from datetime import datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any

from pydantic_core import PydanticCustomError

from testbed.control.registry import check as check_controller
from testbed.errors import UsageError, did_you_mean
from testbed.estimator.buffers import acks_of
from testbed.estimator.model import Model, Restartable
from testbed.estimator.registry import check, checked_options, create, factory_of, model_of
from testbed.estimator.service import role_of as estimator_role
from testbed.orchestrator.roles import roles_of
from testbed.scenario import ClosedLoop, EstimatorSpec, Scenario
from testbed.scenario.backend import real_links
from testbed.scenario.estimator_events import AcksEvent, AddEvent, EstimatorEvent, ShadowEvent, SwapEvent
from testbed.scenario.event_checks import possible_names
from testbed.scenario.events import PROCESS_EVENTS
from testbed.scenario.services import Planned, planned
from testbed.wire.setup import Setup

if TYPE_CHECKING:
    from testbed.orchestrator.services import Services


def check_parts(scenario: Scenario) -> None:
    """Raises UsageError for an estimator that does not exist, has wrong options, or cannot run in this scenario.

    The same for the controller of a closed loop.
    """
    if not scenario.estimators:
        raise UsageError("the scenario has no [[estimators]]; a run needs at least one")
    model = model_of(scenario)
    for spec in scenario.estimators:
        check(spec, model, acks=acks_of(scenario, spec), scenario=scenario)
    for plan in scenario.swaps:
        check_change(plan, scenario, model)
    check_waiting(scenario, model)
    check_roles(scenario)
    check_controller(scenario)


def check_processes(scenario: Scenario) -> None:
    """Raises UsageError for links that need real time and processes, where there are none."""
    names = real_links(scenario)
    if names:
        backend = getattr(scenario.links, names[0]).backend
        raise UsageError(
            f"links.{names[0]}.backend: got {backend!r} with --in-process; allowed there: model (--links model), or "
            "without --in-process"
        )


def check_change(plan: Planned, scenario: Scenario, model: Model) -> None:
    """Raises UsageError where the new service of a change cannot be, or cannot start from what it is to be handed."""
    spec = plan.spec
    if spec is None or plan.promoted is not None:
        return
    where = f"{plan.event.action} of {plan.event.estimator or plan.name!r} at step {plan.step}"
    try:
        check(spec, model, acks=acks_of(scenario, spec), scenario=scenario)
    except UsageError as error:
        raise UsageError(f"{where}: {str(error).removeprefix(f'estimators.{spec.name}: ')}") from None
    if plan.handover == "full" and plan.source is not None:
        old, new = settings_of(plan.source), settings_of(spec)
        if old != new:
            raise UsageError(
                f"{where}: got handover 'full' from {_shown(old)} to {_shown(new)}, which do not share the state; "
                "allowed: moments, cold"
            )
    made = create(spec.kind, model, lanes=1, options=spec.options)
    if not isinstance(made, Restartable):
        raise UsageError(f"{where}: estimator {spec.kind!r} cannot start at a later step; allowed: in [[estimators]]")
    if plan.handover != "full":
        try:
            made.start_from(plan.step - 1, model.x0_mean[None], model.P0[None])
        except UsageError as error:
            raise UsageError(f"{where}: {error}") from None


def check_waiting(scenario: Scenario, model: Model) -> None:
    """Raises UsageError for an event that waits for a condition and whose estimator cannot be, whenever it comes."""
    specs = {spec.name: spec for spec in scenario.estimators}
    for i, event in enumerate(scenario.events):
        if event.timed or not isinstance(event, SwapEvent | AddEvent | ShadowEvent | AcksEvent):
            continue
        if isinstance(event, AcksEvent):
            acks = None if event.acks == "link" else event.acks
            new = [spec.model_copy(update={"acks": acks}) for spec in specs.values()]
            new = [spec for spec in new if event.estimator in (None, spec.name)]
        else:
            like = None if isinstance(event, AddEvent) else specs.get(event.estimator)
            own = event.name if isinstance(event, ShadowEvent) else event.estimator
            new = [] if isinstance(event.to, str) else [event.to.named(own, like)]
        for spec in new:
            try:
                check(spec, model, acks=acks_of(scenario, spec), scenario=scenario)
            except UsageError as error:
                raise UsageError(f"events[{i}]: {str(error).removeprefix(f'estimators.{spec.name}: ')}") from None


def settings_of(spec: EstimatorSpec) -> tuple[str, dict[str, Any]]:
    """The kind of an estimator and its options, those that were left out with their defaults."""
    factory = factory_of(spec.kind)
    parameters = list(inspect.signature(factory).parameters.values())[2:]
    defaults = {p.name: p.default for p in parameters if p.default is not inspect.Parameter.empty}
    return spec.kind, {**defaults, **checked_options(spec.kind, factory, dict(spec.options))}


def plan_of(setup: Setup, services: Services, event: EstimatorEvent, step: int) -> list[Planned]:
    """An event that is to happen while the run goes, checked against all that has happened and is to come.

    Raises UsageError, of one line.
    """
    scenario = setup.scenario
    waiting = [(p.plan.event, p.step if p.step is not None else step) for p in services.pending]
    source = scenario.input
    followed = source.estimator if isinstance(source, ClosedLoop) else None
    known = {id(other): (other, at) for other, at in [*services.made, *waiting]}  # that of ACKs is several changes
    timeline = [*known.values(), (event, step)]
    try:
        plans = planned(scenario.estimators, timeline, steps=scenario.steps, followed=followed)
    except PydanticCustomError as error:
        raise UsageError(str((error.context or {}).get("text", error))) from None
    found = [plan for plan in plans if plan.event is event]
    for plan in found:
        check_change(plan, scenario, model_of(scenario))
        if plan.spec is not None and acks_of(scenario, plan.spec) == "perfect" and not setup.acks_are_of_use:
            raise UsageError("acks: got 'perfect'; allowed: none, for the plant sends no ACKs in this run")
    return found


def check_roles(scenario: Scenario) -> None:
    """Raises UsageError for an event that names a process that the run does not have."""
    for i, event in enumerate(scenario.events):
        if isinstance(event, PROCESS_EVENTS):
            check_role(scenario, event.role, f"events[{i}].role: ")


def check_role(scenario: Scenario, role: str, where: str = "") -> None:
    """The same for one. A role of an estimator is whichever process serves it by then."""
    names = [spec.name for spec in roles_of(scenario) if not spec.name.startswith(estimator_role(""))]
    names += [estimator_role(name) for name in possible_names(scenario.estimators, scenario.events)]
    if role not in names:
        raise UsageError(f"{where}got {role!r}; allowed: {', '.join(names)}{did_you_mean(role, names)}")


def _shown(settings: tuple[str, dict[str, Any]]) -> str:
    options = ", ".join(f"{key} = {value!r}" for key, value in settings[1].items())
    return f"{settings[0]!r}{f' ({options})' if options else ''}"


def default_folder(scenario: Scenario) -> Path:
    """runs/NAME-TIME, one that is not there yet."""
    name = "".join(c if c.isalnum() or c in "._-" else "-" for c in scenario.name)
    path = out = Path("runs") / f"{name}-{datetime.now():%Y%m%d-%H%M%S}"
    number = 1
    while out.exists():
        number += 1
        out = path.with_name(f"{path.name}-{number}")
    return out


def prepare_folder(out: Path) -> None:
    """Make the run's folder. Raises UsageError where that cannot be, or nothing can be written there."""
    probe = out / ".writable"
    try:
        out.mkdir(parents=True, exist_ok=True)
        probe.write_bytes(b"")
        probe.unlink()
    except OSError as error:
        raise UsageError(f"cannot write into {out}: {(error.strerror or str(error)).lower()}") from None
