"""A random timeline for a scenario: events that its [[events]] can express. Each is kept only where it fits."""

from __future__ import annotations

import random
from typing import Any

from faults.scenarios import loss, new_estimator
from testbed.errors import UsageError
from testbed.orchestrator.preflight import check_parts
from testbed.scenario import parse_scenario

Table = dict[str, Any]


def events(draw: random.Random, table: Table) -> list[Table]:
    """Up to six events, in any order of steps."""
    kept: list[Table] = []
    for number in range(draw.choice((0, 1, 2, 4, 6))):
        event = draw.choices(_KINDS, _WEIGHTS)[0](draw, table, number, kept)
        if event is not None and "handover" not in event and draw.random() < 0.15:
            event["when"] = f"trace_P({draw.choice(table['estimators'])['name']}) > {draw.choice((0.5, 2, 5))}"
            del event["at"]
        if event is not None and _fits({**table, "events": [*kept, event]}):
            kept.append(event)
    return kept


def ends(draw: random.Random, table: Table) -> list[Table]:
    """Processes that the timeline ends and starts anew: not part of a run without faults."""
    roles = ["plant", "controller", "link.control", "link.observation", *(f"estimator.{x}" for x in ("a", "b"))]
    out = []
    for _ in range(draw.choice((0, 0, 1, 2))):
        event = {"at": _step(draw, table), "action": draw.choice(("kill", "restart")), "role": draw.choice(roles)}
        if _fits({**table, "events": [*table["events"], *out, event]}):
            out.append(event)
    return out


def _fits(table: Table) -> bool:
    try:
        check_parts(parse_scenario(table))
    except UsageError:
        return False
    return True


def _step(draw: random.Random, table: Table) -> int:
    return draw.randint(1, table["steps"])


def _link(draw: random.Random, table: Table, _: int, kept: list[Table]) -> Table:
    link = draw.choice(("control", "observation", "ack"))
    now = table["links"][link]
    change: Table = {"loss": loss(draw)}
    if "assumed" in change["loss"]:
        change["loss"]["assumed"] = {"kind": "bernoulli", "arrival": 0.7}
    if "delay" in now and draw.random() < 0.5:
        change = {"delay": {"kind": "uniform", "low": "0 s", "high": "20 ms"}}
    return {"at": _step(draw, table), "action": "set", "link": link, "set": change}


def _like(spec: Table) -> Table:
    return {"kind": spec.get("kind", spec["name"]), **{k: v for k, v in spec.items() if k not in ("name", "kind")}}


def _swap(draw: random.Random, table: Table, number: int, kept: list[Table]) -> Table:
    """For one like it with the whole state, or for another one."""
    old = draw.choice(table["estimators"])
    at = {"at": _step(draw, table), "action": "swap", "estimator": old["name"]}
    if draw.random() < 0.4:
        return {**at, "to": _like(old), "handover": "full"}
    return {**at, "to": _other(draw, table, old), "handover": draw.choice(("cold", "moments"))}


def _promote(draw: random.Random, table: Table, number: int, kept: list[Table]) -> Table | None:
    shadows = [event for event in kept if event["action"] in ("shadow", "add")]
    if not shadows:
        return None
    shadow = draw.choice(shadows)
    at = draw.randint(shadow.get("at", 1), table["steps"])
    name = shadow.get("name", shadow["estimator"])
    return {"at": at, "action": "swap", "estimator": draw.choice(table["estimators"])["name"], "to": name}


def _shadow(draw: random.Random, table: Table, number: int, kept: list[Table]) -> Table:
    old = draw.choice(table["estimators"])
    at = {"at": _step(draw, table), "action": "shadow", "estimator": old["name"], "name": f"s{number}"}
    if draw.random() < 0.4:
        return {**at, "to": _like(old), "handover": "full"}
    return {**at, "to": _other(draw, table, old), "handover": draw.choice(("cold", "moments"))}


def _add(draw: random.Random, table: Table, number: int, kept: list[Table]) -> Table:
    to = _other(draw, table, {})
    return {"at": _step(draw, table), "action": "add", "estimator": f"n{number}", "to": to}


def _remove(draw: random.Random, table: Table, number: int, kept: list[Table]) -> Table:
    return {"at": _step(draw, table), "action": "remove", "estimator": draw.choice(table["estimators"])["name"]}


def _cut(draw: random.Random, table: Table, number: int, kept: list[Table]) -> Table:
    links = draw.choice((["control"], ["observation"], ["control", "observation"]))
    cut = any(event["action"] == "partition" for event in kept)
    return {"at": _step(draw, table), "action": "heal" if cut else "partition"} | ({} if cut else {"links": links})


def _acks(draw: random.Random, table: Table, number: int, kept: list[Table]) -> Table:
    name = draw.choice(table["estimators"])["name"]
    return {"at": _step(draw, table), "action": "acks", "estimator": name, "acks": draw.choice(("none", "perfect"))}


def _input(draw: random.Random, table: Table, number: int, kept: list[Table]) -> Table:
    return {"at": _step(draw, table), "action": "input", "input": {"kind": "uniform", "low": -1.0, "high": 2.0}}


def _plant(draw: random.Random, table: Table, number: int, kept: list[Table]) -> Table:
    A = [[round(0.9 * entry, 4) for entry in row] for row in table["system"]["A"]]
    return {"at": _step(draw, table), "action": "plant", "A": A, "over": draw.randint(1, 6)}


def _note(draw: random.Random, table: Table, number: int, kept: list[Table]) -> Table:
    at = _step(draw, table)
    if draw.random() < 0.5:
        return {"at": at, "action": "mark", "name": f"mark {number}"}
    return {"at": at, "action": "snapshot", "estimator": draw.choice(table["estimators"])["name"]}


_KINDS = (_link, _swap, _promote, _shadow, _add, _remove, _cut, _acks, _input, _plant, _note)
_WEIGHTS = (3, 4, 1, 2, 1, 1, 1, 1, 1, 1, 1)


def _other(draw: random.Random, table: Table, old: Table) -> Table:
    spec = new_estimator(draw, table, "x")
    spec.pop("until", None)
    return _like({**spec, "acks": spec.get("acks", old.get("acks", "none"))})
