"""What becomes of each role of a scenario that is lost, and whether that can be."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from testbed.control.controller import RestartableController
from testbed.control.registry import create as create_controller
from testbed.control.service import ROLE as CONTROLLER
from testbed.errors import UsageError
from testbed.estimator.model import Restartable
from testbed.estimator.registry import create, model_of
from testbed.estimator.service import role_of, spec_of
from testbed.orchestrator.roles import RoleSpec
from testbed.scenario import ClosedLoop, EstimatorSpec, PythonInput, Scenario
from testbed.scenario.backend import real_links
from testbed.scenario.recovery import Policy, role_name


def policies_of(
    scenario: Scenario,
    roles: Sequence[RoleSpec],
    external: Sequence[str] = (),
    services: Mapping[str, EstimatorSpec] | None = None,
) -> dict[str, Policy]:
    """By role. external: roles that somebody starts by hand; they are lost for good unless the scenario says otherwise.

    services: the estimators of roles that are not in the scenario.

    Raises UsageError where the scenario names a role that it has not, or asks for what cannot be.
    """
    names = [role.name for role in roles if role.name not in (services or {})]
    known = {*names, *map(role_name, services or ()), *(role_of(spec.name) for spec in scenario.estimators)}
    for role in scenario.recovery.roles:
        if role not in known:
            raise UsageError(f"recovery.roles: got {role!r}; allowed: {', '.join(names)}")
    out: dict[str, Policy] = {}
    for role in names:
        spec = spec_of(scenario, role.removeprefix(_ESTIMATOR)) if role.startswith(_ESTIMATOR) else None
        out[role] = _policy(scenario, role, unable(scenario, role, spec), external=role in external)
    for role, service in (services or {}).items():
        out[role] = policy_of_service(scenario, role, service)
    return out


def silent_roles(
    scenario: Scenario,
    roles: Sequence[RoleSpec],
    policies: Mapping[str, Policy],
    external: Sequence[str] = (),
    services: Mapping[str, EstimatorSpec] | None = None,
) -> dict[str, str]:
    """The roles that may give no state, and why. services: as for ``policies_of``.

    What somebody starts by hand need not be the testbed's own, unless the scenario lets it be started anew.
    """
    specs = {role_of(spec.name): spec for spec in scenario.estimators} | dict(services or {})
    out = {}
    for role in roles:
        if role.name in external and policies.get(role.name) != "restart":
            out[role.name] = "it is started by hand"
        elif (reason := unable(scenario, role.name, specs.get(role.name))) is not None:
            out[role.name] = reason
    return out


def policy_of_service(scenario: Scenario, role: str, spec: EstimatorSpec) -> Policy:
    """Of an estimator's service that joins while the run goes."""
    return _policy(scenario, role_name(role), unable(scenario, role, spec), external=False)


def unable(scenario: Scenario, role: str, spec: EstimatorSpec | None = None) -> str | None:
    """Why a role cannot be started anew in the middle of a run; None where it can. spec: of an estimator."""
    if spec is not None:
        made = create(spec.kind, model_of(scenario), lanes=1, options=spec.options)
        return None if isinstance(made, Restartable) else f"estimator {spec.kind!r} does not give its state"
    if role.removeprefix(_LINK) in real_links(scenario):
        return "what is on its way through real sockets cannot be sent again"
    source = scenario.input
    if role == CONTROLLER and isinstance(source, PythonInput):
        controller = create_controller(source, model_of(scenario), lanes=1, steps=scenario.steps)
        if not isinstance(controller, RestartableController):
            return "the controller does not give its state"
    return None


def _policy(scenario: Scenario, role: str, reason: str | None, *, external: bool) -> Policy:
    recovery = scenario.recovery
    wanted = recovery.wanted(role)
    if wanted == "continue" and _is_followed(scenario, role):
        if role in recovery.roles:
            raise UsageError(
                f"recovery.roles.{role}: got 'continue'; allowed: restart, fail; the controller follows it"
            )
        wanted = None
    if wanted == "restart" and reason is not None:
        key = f"roles.{role}" if role in recovery.roles else "policy"
        others = "continue, fail" if role.startswith(_ESTIMATOR) and not _is_followed(scenario, role) else "fail"
        raise UsageError(f"recovery.{key}: got 'restart' for {role}; allowed: {others}; {reason}")
    if wanted is None:
        return "fail" if reason is not None or external else "restart"
    return wanted


def _is_followed(scenario: Scenario, role: str) -> bool:
    source = scenario.input
    return isinstance(source, ClosedLoop) and role == role_of(source.estimator)


_ESTIMATOR, _LINK = role_of(""), "link."
