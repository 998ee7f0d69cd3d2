"""The presets: every one is a link, other keys replace its own, and an unknown name is one line."""

from __future__ import annotations

from typing import Any, get_args

import pytest

from testbed.errors import UsageError
from testbed.scenario import parse_scenario
from testbed.scenario.presets import Direction, presets, resolved

NAMES = sorted(presets())
SYSTEM = {"A": [[1.0]], "C": [[1.0]], "Q": [[1.0]], "R": [[1.0]]}


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize("direction", get_args(Direction))
def test_every_preset_is_a_link(name: str, direction: Direction) -> None:
    table = resolved({"preset": name}, direction)
    assert table
    parse_scenario({"system": SYSTEM, "links": {"control": table, "observation": table}})


def test_directions_differ_where_the_source_has_one_loss_only() -> None:
    """mm-loss uplink 0.0477 and a queue of 14 packets, in the uplink only."""
    up, down = (resolved({"preset": "pantheon-nepal-wifi"}, direction) for direction in get_args(Direction))
    assert up["loss"] == {"kind": "bernoulli", "loss": 0.0477}
    assert up["rate"]["queue_packets"] == 14
    assert "loss" not in down
    assert "queue_packets" not in down["rate"]
    assert up["delay"] == down["delay"] == {"kind": "constant", "by": "28 ms"}


def test_keys_beside_the_preset_replace_its_own_as_a_whole() -> None:
    loss = {"kind": "none"}
    given = {"preset": "firebase-lte", "loss": loss, "on_loss": "noise"}
    table = resolved(given, None)
    plain = resolved({"preset": "firebase-lte"}, None)
    assert table == {**plain, "loss": loss, "on_loss": "noise"}
    assert given["preset"] == "firebase-lte"


def test_a_result_may_be_changed_without_harm() -> None:
    changed = resolved({"preset": "firebase-lte"}, "up")
    changed.pop("loss")
    changed["rate"].clear()
    assert resolved({"preset": "firebase-lte"}, "up")["rate"]["bits_per_second"] == 16e6


def test_a_table_without_preset_stays() -> None:
    assert resolved({"loss": {"kind": "none"}}, None) == {"loss": {"kind": "none"}}


@pytest.mark.parametrize(
    ("given", "direction", "error"),
    [
        ("firebase-ltf", "up", r"^preset: got 'firebase-ltf', no such preset; .*; did you mean 'firebase-lte'\?$"),
        (3, "up", r"^preset: got 3; allowed: the name of a preset, pantheon-nepal-wifi, "),
        ("firebase-hspa-poor", None, r"^preset: firebase-hspa-poor differs up and down; allowed here: .*firebase-lte,"),
    ],
)
def test_what_is_no_preset_is_one_line(given: Any, direction: Direction | None, error: str) -> None:
    with pytest.raises(UsageError, match=error) as raised:
        resolved({"preset": given}, direction)
    assert "\n" not in str(raised.value)
