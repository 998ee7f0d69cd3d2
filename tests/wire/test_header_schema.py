"""The published JSON Schema and the codec accept and refuse the same headers."""

from __future__ import annotations

import copy
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from jsonschema import Draft202012Validator

from testbed.wire.codec import Rejected, encode
from testbed.wire.messages import MESSAGES, messages_json_schema
from wire.samples import OTHERS, PACKETS, decoder, header_of, messages, payload_of, tail_of

SCHEMA = messages_json_schema()
OF_ANY = Draft202012Validator(SCHEMA)
OF_TYPE = {
    kind: Draft202012Validator({**SCHEMA["$defs"][kind], "$schema": SCHEMA["$schema"]}) for kind in SCHEMA["$defs"]
}

wrong_values = st.one_of(
    st.none(),
    st.booleans(),
    st.integers(-3, 3),
    st.sampled_from([2**63 - 1, 2**63, 2**31, 2**31 + 1, -(2**70), 0.5, -1.5]),
    st.sampled_from(["", "a", "A", "stop", "stopped", "control", "<f8", "x" * 2001, "x" * 33, "ab cd", "é" * 9]),
    st.lists(st.sampled_from([0, "y", [], None]), max_size=3),
    st.dictionaries(st.sampled_from(["a", "v"]), st.sampled_from([0, 1.5, "b"]), max_size=1),
)


def test_the_schema_is_a_schema() -> None:
    Draft202012Validator.check_schema(SCHEMA)
    for definition in SCHEMA["$defs"].values():
        Draft202012Validator.check_schema(definition)
    assert set(SCHEMA["$defs"]) == set(MESSAGES)


@pytest.mark.parametrize("kind", [*PACKETS, *OTHERS])
@settings(deadline=None, max_examples=25)
@given(data=st.data())
def test_what_is_sent_is_valid_as_its_type_and_as_no_other(kind: str, data: st.DataObject) -> None:
    header = header_of(encode(*data.draw(messages(kind))))
    OF_ANY.validate(header)
    assert [other for other, schema in OF_TYPE.items() if schema.is_valid(header)] == [kind]


def containers(value: Any) -> list[Any]:
    """All lists and tables within a value."""
    inner = value.values() if isinstance(value, dict) else value if isinstance(value, list) else ()
    return ([value] if isinstance(value, dict | list) else []) + [c for entry in inner for c in containers(entry)]


@st.composite
def mutated(draw: st.DrawFn, kind: str) -> tuple[dict[str, Any], bytes]:
    """A valid header of which one or two entries, at any depth, are changed, removed or added."""
    message, arrays = draw(messages(kind))
    header: dict[str, Any] = copy.deepcopy(header_of(encode(message, arrays)))
    for _ in range(draw(st.integers(0, 2))):
        target = draw(st.sampled_from(containers(header)))
        value = copy.deepcopy(draw(wrong_values))
        keys = list(target) if isinstance(target, dict) else list(range(len(target)))
        what = draw(st.sampled_from(["change", "remove", "add"] if keys else ["add"]))
        if what == "add":
            target.append(value) if isinstance(target, list) else target.update({draw(st.sampled_from("abv")): value})
        elif what == "change":
            target[draw(st.sampled_from(keys))] = value
        else:
            target.pop(draw(st.sampled_from(keys)))
    return header, tail_of(arrays)


@pytest.mark.parametrize("kind", [*PACKETS, *OTHERS])
@settings(deadline=None, max_examples=150)
@given(data=st.data())
def test_codec_and_schema_agree_on_changed_headers(kind: str, data: st.DataObject) -> None:
    """The codec knows more than the schema (sizes, the run): only its reason "schema" is compared."""
    header, tail = data.draw(mutated(kind))
    try:
        decoder(kind).decode(payload_of(header, tail))
        refused = False
    except Rejected as refusal:
        refused = refusal.reason == "schema"
    assert OF_TYPE[kind].is_valid(header) == (not refused)
    if not refused:
        OF_ANY.validate(header)


@pytest.mark.parametrize("kind", [*PACKETS, *OTHERS])
@pytest.mark.parametrize("key", ["v", "type", "run", "source", "seq"])
def test_what_every_message_carries_is_required(kind: str, key: str) -> None:
    assert key in SCHEMA["$defs"][kind]["required"]


@pytest.mark.parametrize("kind", PACKETS)
def test_the_schema_lists_the_arrays(kind: str) -> None:
    listed = SCHEMA["$defs"][kind]["x-arrays"]
    assert {name: (a["dtype"], tuple(a["shape"]), a["required"]) for name, a in listed.items()} == {
        name: (rule.dtype, rule.shape, rule.required) for name, rule in MESSAGES[kind].ARRAYS.items()
    }
