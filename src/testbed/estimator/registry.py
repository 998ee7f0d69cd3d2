"""Estimators by name: those of the testbed and those that other packages register.

A package registers its own under the entry-point group ``testbed.estimators``; the object is called with
(model, lanes, **options), as the classes here are.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from importlib import import_module
from importlib.metadata import entry_points
from typing import Any

import numpy as np

from testbed import plugins
from testbed.channel.in_time import law_of_link
from testbed.errors import UsageError, did_you_mean
from testbed.estimator.model import Estimator, Model
from testbed.scenario import EstimatorSpec, Scenario

BUILT_IN = {
    "aoe": "testbed.estimator.aoe:Aoe",
    "ff": "testbed.estimator.ff:Ff",
    "gpb": "testbed.estimator.gpb:Gpb",
    "gpb1": "testbed.estimator.gpb1:Gpb1",
    "gpb2": "testbed.estimator.gpb2:Gpb2",
    "imm": "testbed.estimator.imm:Imm",
    "kf": "testbed.estimator.kf:Kf",
    "kfio": "testbed.estimator.kfio:Kfio",
    "lmmse": "testbed.estimator.lmmse:Lmmse",
    "oe": "testbed.estimator.oe:Oe",
    "oe-exact": "testbed.estimator.oe_exact:OeExact",
    "pf": "testbed.estimator.pf:Pf",
    "rse": "testbed.estimator.rse:Rse",
    "rseio": "testbed.estimator.rseio:Rseio",
    "rsemm": "testbed.estimator.rsemm:Rsemm",
}
GROUP = "testbed.estimators"


def kinds() -> list[str]:
    """All names that ``create`` knows."""
    return sorted({*BUILT_IN, *(point.name for point in entry_points(group=GROUP))})


def create(
    kind: str, model: Model, *, lanes: int, options: Mapping[str, Any] | None = None, lane: int = 0
) -> Estimator:
    """An estimator for the lanes lane … lane + lanes − 1 of a run.

    One that draws random numbers has ``begin_at(lane)``, so that its draws do not depend on how lanes are split.

    Raises UsageError for an unknown kind or option, or where the estimator does not hold for the model.
    """
    factory = factory_of(kind)
    made = factory(model, lanes, **checked_options(kind, factory, dict(options or {})))
    check_actuator(made, model)
    begin_at = getattr(made, "begin_at", None)
    if begin_at is not None:
        begin_at(lane)
    return made


def kind_of(estimator: Estimator) -> str:
    """The name of a built-in estimator, MODULE:CLASS of another."""
    path = f"{type(estimator).__module__}:{type(estimator).__qualname__}"
    return next((kind for kind, known in BUILT_IN.items() if known == path), path)


def check_actuator(estimator: Estimator, model: Model) -> None:
    """Raises UsageError where the actuator holds its last input and the estimator does not have ``takes_hold = True``.

    One that is not made for it would be wrong without a word.
    """
    if model.holds and not getattr(estimator, "takes_hold", False):
        raise UsageError(
            f"estimator {kind_of(estimator)!r} is for an actuator that applies zero on a loss, and this one has "
            'on_loss = "hold"; allowed: "zero", or an estimator that knows the input applied last (gpb, oe-exact)'
        )


def check(spec: EstimatorSpec, model: Model, *, acks: str, scenario: Scenario) -> None:
    """Raises UsageError where an estimator of a scenario cannot be made, or says that it cannot run in it.

    For the latter its class may have ``check_scenario(scenario, acks, until)``, with the step at which it ends.
    """
    try:
        estimator = create(spec.kind, model, lanes=1, options=spec.options)
        own_check = getattr(estimator, "check_scenario", None)
        if own_check is not None:
            own_check(scenario, acks, spec.until or scenario.steps)
    except UsageError as error:
        raise UsageError(f"estimators.{spec.name}: {error}") from None


def model_of(scenario: Scenario) -> Model:
    """What estimators know of a scenario."""
    system = scenario.system
    g = np.eye(system.n) if system.G is None else np.array(system.G)
    uncertainty = scenario.uncertainty
    d_a, d_g, d_c = (uncertainty.dA, uncertainty.dG, uncertainty.dC) if uncertainty is not None else ((), (), ())
    return Model(
        A=np.array(system.A),
        B=None if system.B is None else np.array(system.B),
        C=np.array(system.C),
        Q=g @ np.array(system.Q) @ g.T,
        R=np.array(system.R),
        x0_mean=np.array(system.x0_mean),
        P0=np.array(system.P0),
        control=law_of_link(scenario, "control"),
        observation=law_of_link(scenario, "observation"),
        G=g,
        W=np.array(system.Q),
        dA=tuple(np.array(d) for d in d_a),
        dG=tuple(np.array(d) for d in d_g),
        dC=tuple(np.array(d) for d in d_c),
        on_loss=scenario.actuator.on_loss,
    )


def factory_of(kind: str) -> Callable[..., Estimator]:
    """What makes estimators of a kind. Raises UsageError for an unknown one."""
    if kind in BUILT_IN:
        module, name = BUILT_IN[kind].split(":")
        found: Callable[..., Estimator] = getattr(import_module(module), name)
        return found
    for point in entry_points(group=GROUP, name=kind):
        loaded: Callable[..., Estimator] = point.load()
        return loaded
    raise UsageError(f"unknown estimator {kind!r}; allowed: {', '.join(kinds())}{did_you_mean(kind, kinds())}")


def checked_options(kind: str, factory: Callable[..., Estimator], options: dict[str, Any]) -> dict[str, Any]:
    """``plugins.checked_options`` of an estimator of that kind. Raises UsageError."""
    return plugins.checked_options(f"estimator {kind!r}", factory, options, EstimatorSpec.reserved)
