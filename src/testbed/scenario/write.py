"""A scenario as a table and as TOML, every default written out."""

import re
from typing import Any

import tomli_w

from testbed.scenario.events import Event
from testbed.scenario.models import Scenario

_NUMBERS = re.compile(r"\[\n((?: *[-+0-9.eE]+,\n)+) *\]")
"""An array of numbers over several lines, as the writer leaves it. Texts hold no line break, so none is matched."""


def to_dict(scenario: Scenario) -> dict[str, Any]:
    """The resolved scenario as plain tables, lists, texts and numbers; what is left out has no value in TOML."""
    table = _without_none(scenario.model_dump(mode="json", by_alias=True, exclude={"events"}))
    estimators = table.pop("estimators")
    if estimators:
        table["estimators"] = [_flat(spec) for spec in estimators]
    if scenario.events:
        table["events"] = [event_table(event) for event in scenario.events]
    result: dict[str, Any] = table
    return result


def event_table(event: Event) -> dict[str, Any]:
    """An event as in the file."""
    table: dict[str, Any] = _without_none(event.model_dump(mode="json", by_alias=True))
    return {**table, "to": _flat(table["to"])} if isinstance(table.get("to"), dict) else table


def _flat(spec: dict[str, Any]) -> dict[str, Any]:
    """An estimator's table as in the file: its options are keys of it."""
    return {**{key: value for key, value in spec.items() if key != "options"}, **spec["options"]}


def to_toml(scenario: Scenario) -> str:
    """The resolved scenario as TOML. It loads back to an equal scenario: numbers are written exactly."""
    return _NUMBERS.sub(_one_line, tomli_w.dumps(to_dict(scenario)))


def _one_line(match: re.Match[str]) -> str:
    return f"[{', '.join(match[1].replace(',', ' ').split())}]"


def _without_none(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: _without_none(entry) for key, entry in value.items() if entry is not None}
    if isinstance(value, list):
        return [_without_none(entry) for entry in value]
    return value
