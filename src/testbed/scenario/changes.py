"""Changes of a link while a run goes: some keys of its table get other values."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, TypeVar, cast

from pydantic import ValidationError

from testbed.errors import UsageError, did_you_mean
from testbed.scenario.base import shown
from testbed.scenario.links import Impairments

L = TypeVar("L", bound=Impairments)

_REMOVED = "none"
_ALTERNATIVES = {
    "arrival": ({"loss"}, {"arrival"}),
    "recovery": ({"loss", "mean_burst"}, {"recovery", "failure"}),
}
"""By a key of the resolved loss: the keys that may be given instead, and those that they replace."""


def changed(link: L, change: Mapping[str, Any]) -> L:
    """A link with other values for some keys of its table; those of a table within it change one by one.

    A table with another ``kind`` replaces what was there, and the text "none" removes a stage.
    Raises UsageError, of one line, where the result is no link. ``change`` is not changed.
    """
    from testbed.scenario.explain import explain

    allowed = [key for key in Impairments.model_fields if key != "up"]  # a partition sets that
    for key in change:
        if key not in Impairments.model_fields:
            hint = did_you_mean(key, allowed)
            raise UsageError(f"{key}: cannot be set while a run goes; allowed: {', '.join(allowed)}{hint}")
    table = link.model_dump(mode="json")
    for key, value in change.items():
        table[key] = _merged(table.get(key), value)
    if change.get("slot") == _REMOVED or (change.get("clock") == "packet" and "slot" not in change):
        table["slot"] = None
    try:
        return type(link).model_validate(_without_none(table))
    except ValidationError as error:
        raise UsageError(explain(error, type(link))) from None


def in_turn(link: L, changes: Sequence[Mapping[str, Any]]) -> list[L]:
    """The link at first, and after each change. Raises UsageError where one does not fit."""
    out = [link]
    for change in changes:
        out.append(changed(out[-1], change))
    return out


def _merged(before: Any, value: Any) -> Any:
    if value == _REMOVED:
        return None
    if not isinstance(value, Mapping):
        return value
    if not isinstance(before, Mapping) or value.get("kind", before.get("kind")) != before.get("kind"):
        return dict(value)
    table = {key: entry for key, entry in before.items() if entry is not None}
    for known, (instead, replaced) in _ALTERNATIVES.items():
        if known in table and instead & set(value):
            table = {**{key: entry for key, entry in table.items() if key not in replaced}, **_others(table, instead)}
    return {**table, **value}


def _others(table: Mapping[str, Any], instead: set[str]) -> dict[str, float]:
    """The present values of the keys that may be given instead."""
    if instead == {"loss"}:
        return {}
    recovery, failure = table["recovery"], table["failure"]
    return {"loss": failure / (recovery + failure), "mean_burst": 1.0 / recovery if recovery else float("inf")}


def _without_none(table: Any) -> Any:
    if isinstance(table, dict):
        return {key: _without_none(entry) for key, entry in table.items() if entry is not None}
    return table


def parse_setting(text: str) -> dict[str, Any]:
    """``loss.failure=0.4`` as {"loss": {"failure": 0.4}}; a value is a number, true, false, or else a text.

    Raises UsageError for what has another form.
    """
    import tomllib

    key, equals, value = text.partition("=")
    parts = [part.strip() for part in key.split(".")]
    if not equals or not all(part.replace("_", "").isalnum() for part in parts):
        raise UsageError(f"got {shown(text)}; allowed: KEY=VALUE, such as loss.failure=0.4 or delay.by='20 ms'")
    try:
        out: Any = tomllib.loads(f"value = {value.strip()}")["value"]
    except ValueError:
        out = value.strip()
    for part in reversed(parts):
        out = {part: out}
    return cast("dict[str, Any]", out)


def together(settings: list[dict[str, Any]]) -> dict[str, Any]:
    """Several settings as one table. Raises UsageError where a key has a value and a table."""
    total: dict[str, Any] = {}
    for setting in settings:
        _add(total, setting, "")
    return total


def _add(total: dict[str, Any], setting: Mapping[str, Any], where: str) -> None:
    for key, value in setting.items():
        known = total.get(key)
        if isinstance(known, dict) and isinstance(value, Mapping):
            _add(known, value, f"{where}{key}.")
        elif key in total and isinstance(known, dict) != isinstance(value, Mapping):
            raise UsageError(f"{where}{key}: got a value and a table; allowed: one of them")
        else:
            total[key] = dict(value) if isinstance(value, Mapping) else value
