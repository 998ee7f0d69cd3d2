"""The AsyncAPI document: its references hold, and it has the keys and messages that there are."""

from __future__ import annotations

from typing import Any

from testbed.wire.asyncapi import asyncapi
from testbed.wire.keys import Keys
from testbed.wire.messages import MESSAGES, messages_json_schema

DOCUMENT = asyncapi()


def references(value: Any) -> list[str]:
    inner = value.values() if isinstance(value, dict) else value if isinstance(value, list) else ()
    own = [value["$ref"]] if isinstance(value, dict) and isinstance(value.get("$ref"), str) else []
    return own + [reference for entry in inner for reference in references(entry)]


def test_every_reference_leads_somewhere() -> None:
    found = references(DOCUMENT)
    assert found
    for reference in found:
        place: Any = DOCUMENT
        assert reference.startswith("#/")
        for part in reference[2:].split("/"):
            place = place[part]
        assert place


def test_every_type_of_message_has_its_schema_and_a_channel() -> None:
    assert set(DOCUMENT["components"]["messages"]) == set(MESSAGES)
    assert DOCUMENT["components"]["schemas"] == messages_json_schema()["$defs"]
    assert {name for channel in DOCUMENT["channels"].values() for name in channel["messages"]} == set(MESSAGES)


def test_parameters_are_those_of_the_addresses() -> None:
    for channel in DOCUMENT["channels"].values():
        names = {part[1:-1] for part in channel["address"].split("/") if part.startswith("{")}
        assert set(channel["parameters"]) == names
        assert "run" in names


def test_addresses_are_the_keys_of_a_run() -> None:
    keys = Keys("{run}")
    addresses = {channel["address"] for channel in DOCUMENT["channels"].values()}
    links = [key for link in ("control", "observation", "ack") for key in (keys.sent(link), keys.delivered(link))]  # type: ignore[arg-type]
    links.append(keys.change("{part}"))
    others = [keys.clock, keys.command, keys.truth, keys.bounds, keys.estimate("{name}"), keys.status("{role}")]
    assert addresses == {*links, *others, "testbed/{run}/tap/{link}/{end}"}
    assert keys.tap(keys.sent("control")) == "testbed/{run}/tap/control/sent"
