"""A resolved scenario loads back to an equal one, and fits the published JSON Schema."""

import tomllib
from collections.abc import Iterator
from typing import Any

import jsonschema
import pytest
from hypothesis import HealthCheck, given, settings

from scenario.strategies import scenarios
from testbed.scenario import parse_scenario, scenario_json_schema, to_dict, to_toml

SCHEMA = scenario_json_schema()
VALIDATOR = jsonschema.Draft202012Validator(SCHEMA)
SYSTEM = {"A": [[1.0]], "B": [[1.0]], "C": [[1.0]], "Q": [[1.0]], "R": [[1.0]]}


@settings(deadline=None, suppress_health_check=[HealthCheck.too_slow])
@given(scenarios())
def test_toml_round_trip(table: dict[str, Any]) -> None:
    scenario = parse_scenario(table)
    text = to_toml(scenario)
    assert parse_scenario(text) == scenario
    assert to_toml(parse_scenario(text)) == text
    assert tomllib.loads(text) == to_dict(scenario)


@settings(deadline=None, suppress_health_check=[HealthCheck.too_slow])
@given(scenarios())
def test_schema_accepts_what_the_loader_accepts(table: dict[str, Any]) -> None:
    VALIDATOR.validate(table)
    VALIDATOR.validate(to_dict(parse_scenario(table)))


def test_schema_is_a_schema() -> None:
    jsonschema.Draft202012Validator.check_schema(SCHEMA)


@pytest.mark.parametrize(
    "wrong",
    [
        {"lane": 2},
        {"steps": 0},
        {"seed": -1},
        {"clock": {"mode": "wall"}},
        {"clock": {"mode": "real", "deadlines": "hard"}},
        {"clock": {"period": "10"}},
        {"system": {"A": [[1.0]]}},
        {"estimators": [{"name": "OE"}]},
        {"links": {"control": {"loss": {"arrival": 0.5}}}},
        {"links": {"control": {"loss": {"kind": "bernoulli", "arrival": 1.5}}}},
        {"links": {"control": {"loss": {"kind": "bernoulli", "arrival": 0.5, "loss": 0.5}}}},
        {"links": {"control": {"loss": {"kind": "markov", "recovery": 0.5}}}},
        {"input": {"kind": "table"}},
        {"input": {"kind": "sine"}},
    ],
)
def test_schema_refuses(wrong: dict[str, Any]) -> None:
    assert not VALIDATOR.is_valid({"system": SYSTEM, **wrong})


@pytest.mark.parametrize(
    "right",
    [
        {},
        {"input": {"kind": "table", "file": "u.csv"}},
        {"input": {"kind": "table", "values": [[1]]}},
        {"estimators": [{"name": "gpb1", "depth": 1}]},
        {"links": {"control": {"loss": {"kind": "markov", "loss": 0.1, "mean_burst": 3}}}},
    ],
)
def test_schema_accepts(right: dict[str, Any]) -> None:
    VALIDATOR.validate({"system": SYSTEM, **right})


def _properties(schema: Any, where: str = "") -> Iterator[tuple[str, dict[str, Any]]]:
    if isinstance(schema, dict):
        for name, entry in schema.get("properties", {}).items():
            yield f"{where}/{name}", entry
        for key, entry in schema.items():
            yield from _properties(entry, f"{where}/{key}")


def test_every_key_is_described() -> None:
    found = dict(_properties(SCHEMA))
    assert len(found) > 50
    assert [where for where, entry in found.items() if not entry.get("description")] == []
