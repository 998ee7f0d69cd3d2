"""Links that take time: every wrong value gives one line that says where, what was given, and what is allowed."""

from __future__ import annotations

from typing import Any

import pytest

from scenario.test_wrong_input import changed, message
from testbed.errors import UsageError
from testbed.scenario import parse_scenario

OBS, ACK, CON = "links.observation", "links.ack", "links.control"
WRONG: list[tuple[dict[str, Any], str, str]] = [
    ({f"{OBS}.deadline": "11 ms"}, f"{OBS}.deadline", "11 ms"),
    ({f"{CON}.deadline": "2 s", "clock.period": "1 s"}, f"{CON}.deadline", "2 s"),
    ({f"{OBS}.deadline": "0 s"}, f"{OBS}.deadline", "0 s"),
    ({f"{OBS}.deadline": 5}, f"{OBS}.deadline", "5"),
    ({f"{OBS}.clock": "times", f"{OBS}.slot": "1 ms"}, f"{OBS}.clock", "time"),
    ({f"{OBS}.clock": "time", f"{OBS}.slot": "0 ms"}, f"{OBS}.slot", "0 ms"),
    ({f"{OBS}.clock": "time", f"{OBS}.slot": "1"}, f"{OBS}.slot", "1"),
    ({f"{OBS}.delay": {"kind": "gamma"}}, f"{OBS}.delay.kind", "gamma"),
    ({f"{OBS}.delay": {"kind": "constant", "by": "-1 ms"}}, f"{OBS}.delay.by", "-1 ms"),
    ({f"{OBS}.delay": {"kind": "constant", "by": "1 ms", "in_order": True}}, f"{OBS}.delay", "in_order"),
    ({f"{OBS}.delay": {"kind": "constant"}}, f"{OBS}.delay.by", "missing"),
    ({f"{OBS}.delay": {"kind": "normal", "mean": "1 ms", "std": "0 s"}}, f"{OBS}.delay.std", "0 s"),
    ({f"{OBS}.delay": {"kind": "log-normal", "median": "0 s", "sigma": 1.0}}, f"{OBS}.delay.median", "0 s"),
    ({f"{OBS}.delay": {"kind": "log-normal", "median": "1 s", "sigma": -1.0}}, f"{OBS}.delay.sigma", "-1"),
    ({f"{OBS}.delay": {"kind": "table", "values": []}}, f"{OBS}.delay.values", "[]"),
    ({f"{OBS}.delay": {"kind": "table", "values": [1.0], "unit": "h"}}, f"{OBS}.delay.unit", "'h'"),
    ({f"{OBS}.delay": {"kind": "table", "file": "none.csv"}}, f"{OBS}.delay.file", "no such file"),
    ({f"{OBS}.rate": {"burst_bytes": 10}}, f"{OBS}.rate.bits_per_second", "missing"),
    ({f"{OBS}.rate": {"bits_per_second": -1.0}}, f"{OBS}.rate.bits_per_second", "-1"),
    ({f"{OBS}.rate": {"bits_per_second": 1e6, "queue_packets": 0}}, f"{OBS}.rate.queue_packets", "0"),
    ({f"{OBS}.rate": {"bits_per_second": 1e6, "burst_bytes": -1}}, f"{OBS}.rate.burst_bytes", "-1"),
    ({f"{OBS}.rate": {"bits_per_second": 1e6, "burst": 1}}, f"{OBS}.rate", "did you mean 'burst_bytes'?"),
    ({f"{OBS}.reorder": {"chance": 1.5, "by": "1 ms"}}, f"{OBS}.reorder.chance", "1.5"),
    ({f"{OBS}.reorder": {"chance": 0.5}}, f"{OBS}.reorder.by", "missing"),
    ({f"{OBS}.duplicate": {"chance": 0.5, "after": "soon"}}, f"{OBS}.duplicate.after", "soon"),
    ({f"{OBS}.corrupt": {"chance": -0.1}}, f"{OBS}.corrupt.chance", "-0.1"),
    ({f"{OBS}.corrupt": 0.1}, f"{OBS}.corrupt", "0.1"),
    ({f"{OBS}.assumed": {"kind": "markov"}}, f"{OBS}.assumed", "recovery"),
    ({f"{OBS}.on_loss": "noise", f"{OBS}.delay": {"kind": "constant", "by": "1 ms"}}, f"{OBS}.on_loss", "noise"),
    ({f"{ACK}.mode": "link", f"{ACK}.batch": 0}, f"{ACK}.batch", "0"),
    ({f"{ACK}.mode": "link", f"{ACK}.batch": 5000}, f"{ACK}.batch", "5000"),
    ({f"{ACK}.mode": "perfect", f"{ACK}.batch": 2}, f"{ACK}.batch", "only with mode 'link'"),
    ({f"{ACK}.deadline": "1 ms"}, f"{ACK}.deadline", "only with mode 'link'"),
    (
        {f"{ACK}.mode": "perfect", f"{ACK}.delay": {"kind": "constant", "by": "1 ms"}},
        f"{ACK}.delay",
        "only with mode 'link'",
    ),
    ({f"{CON}.batch": 2}, CON, "unknown key 'batch'"),
    ({"estimators": [{"name": "aoe", "buffer": -1}]}, "estimators[0].buffer", "-1"),
    ({"estimators": [{"name": "aoe", "buffer": 1.5}]}, "estimators[0].buffer", "1.5"),
]


@pytest.mark.parametrize(
    ("changes", "where", "given"), WRONG, ids=lambda value: value if isinstance(value, str) else ""
)
def test_wrong_links(changes: dict[str, Any], where: str, given: str) -> None:
    text = message(changed(changes))
    assert text.startswith(f"{where}: "), text
    assert given in text


def test_a_slot_is_not_too_short_for_the_period() -> None:
    system = {"A": [[1.0]], "B": [[1.0]], "C": [[1.0]], "Q": [[1.0]], "R": [[1.0]]}
    tables: dict[str, Any] = {"system": system, "links": {"control": {"clock": "time", "slot": "9999 ns"}}}
    with pytest.raises(UsageError) as refusal:
        parse_scenario(tables)
    assert str(refusal.value) == (
        "scenario: links.control.slot: got '9999 ns'; allowed: '10 us' or more, with the period '10 ms'"
    )
    tables["links"]["control"]["slot"] = "10 us"
    assert parse_scenario(tables).links.control.slot == "10 us"


def test_a_trace_that_ends_before_the_last_slot_is_refused() -> None:
    system = {"A": [[1.0]], "C": [[1.0]], "Q": [[1.0]], "R": [[1.0]]}
    loss = {"kind": "trace", "fates": "1" * 20, "repeat": False}
    link = {"loss": loss, "clock": "time", "slot": "5 ms"}  # 2 slots a period
    parse_scenario({"steps": 10, "system": system, "links": {"observation": link}})
    with pytest.raises(UsageError, match=r"links\.observation\.loss"):
        parse_scenario({"steps": 11, "system": system, "links": {"observation": link}})
