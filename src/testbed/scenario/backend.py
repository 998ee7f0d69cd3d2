"""The same scenario with other links beneath."""

from __future__ import annotations

from testbed.scenario.links import Backend, Links
from testbed.scenario.load import parse_scenario
from testbed.scenario.models import Scenario
from testbed.scenario.write import to_dict


def with_backend(scenario: Scenario, backend: Backend) -> Scenario:
    """Every link that carries packets with this backend. Raises UsageError where a link does not allow it."""
    tables = to_dict(scenario)
    for name in Links.model_fields:
        if name != "ack" or scenario.links.ack.mode == "link":
            tables["links"][name]["backend"] = backend
    return parse_scenario(tables)


def real_links(scenario: Scenario) -> list[str]:
    """The links that go through real sockets."""
    return [name for name in Links.model_fields if getattr(scenario.links, name).is_real]
