"""The model that a trace is compared with: of a scenario's link, or the one that fits the trace best."""

from __future__ import annotations

import tomllib

from pydantic import TypeAdapter

from testbed.analysis.fit import fit_losses
from testbed.analysis.trace_figures import Model, Packets, can_be_fitted
from testbed.channel.chains import chain_of
from testbed.channel.compared import comparable
from testbed.scenario import Loss, Scenario
from testbed.wire.keys import LinkName

_LOSS: TypeAdapter[Loss] = TypeAdapter(Loss)


def model_of_link(scenario: Scenario, link: LinkName) -> tuple[Model | None, list[str]]:
    """The laws of a link of a scenario, and notes on what has none."""
    found = comparable(scenario, link)
    if found.losses is None:
        return None, list(found.notes)
    kind = getattr(scenario.links, link).loss.kind
    return Model(f"{kind}, of the scenario", found.losses, 0, found.delay), list(found.notes)


def fitted_model(packets: Packets) -> tuple[Model | None, list[str]]:
    """The loss model of least BIC, where the trace has enough of both fates to fit one."""
    if not can_be_fitted(packets.arrived):
        return None, ["too few packets, or all of one fate: no loss model can be fitted"]
    fit = fit_losses(packets.arrived)
    best = next(model for model in fit.models if model.kind == fit.chosen)
    loss = _LOSS.validate_python(tomllib.loads(best.toml)["loss"])
    return Model(f"{best.kind}, fitted", chain_of(loss), len(best.parameters)), [best.toml]
