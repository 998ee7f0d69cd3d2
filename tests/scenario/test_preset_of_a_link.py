"""The key `preset` of a link's table."""

from __future__ import annotations

from typing import Any

import jsonschema
import pytest

from testbed.errors import UsageError
from testbed.scenario import parse_scenario, scenario_json_schema, to_dict
from testbed.scenario.presets import presets

SYSTEM = {"A": [[1.0]], "B": [[1.0]], "C": [[1.0]], "Q": [[1.0]], "R": [[1.0]]}


def links(**tables: Any) -> dict[str, Any]:
    return {"system": SYSTEM, "links": tables}


@pytest.mark.parametrize("name", list(presets()))
def test_every_preset_stands_for_its_keys_in_each_direction(name: str) -> None:
    preset = presets()[name]
    for link, direction, more in (("control", "down", {}), ("observation", "up", {}), ("ack", "up", {"mode": "link"})):
        short = parse_scenario(links(**{link: {"preset": name, **more}}))
        long = parse_scenario(links(**{link: {**preset.link(direction), **more}}))
        assert short == long
        assert parse_scenario(to_dict(short)) == short


def test_keys_beside_it_replace_its_own() -> None:
    given = parse_scenario(links(observation={"preset": "pantheon-nepal-wifi", "loss": {"kind": "none"}}))
    assert given.links.observation.loss.kind == "none"
    assert given.links.observation.rate is not None


def test_an_unknown_one_is_named_with_the_nearest() -> None:
    with pytest.raises(UsageError) as refusal:
        parse_scenario(links(observation={"preset": "pantheon-nepal-wif"}))
    assert str(refusal.value).startswith("scenario: links.observation.preset: got 'pantheon-nepal-wif', no such preset")
    assert str(refusal.value).endswith("did you mean 'pantheon-nepal-wifi'?")


def test_it_is_in_the_schema() -> None:
    schema = scenario_json_schema()
    jsonschema.validate(links(observation={"preset": "pantheon-nepal-wifi"}), schema)
    with pytest.raises(jsonschema.ValidationError):
        jsonschema.validate(links(observation={"preset": "nepal"}), schema)
