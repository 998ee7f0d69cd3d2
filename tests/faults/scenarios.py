"""A small scenario from a seed: any kind of system, losses, links, inputs and estimators, in few steps."""

from __future__ import annotations

import random
from typing import Any

from testbed.errors import UsageError
from testbed.orchestrator.preflight import check_parts
from testbed.scenario import parse_scenario

Table = dict[str, Any]
_TRIES = 8
OPTIONS: dict[str, Table] = {"gpb": {"order": 2}, "pf": {"particles": 6}}
"""Of kinds that need some, or that would take long without."""
CHEAP = ("aoe", "ff", "gpb", "gpb1", "gpb2", "imm", "kf", "kfio", "lmmse", "pf", "oe", "rse", "rseio", "rsemm")
_WEIGHTS = (6, 3, 2, 2, 1, 3, 1, 4, 1, 1, 1, 1, 1, 1)
_NEEDS_ACKS = ("kf", "kfio", "rse", "rseio", "rsemm")
_OE_UNTIL = 8


def scenario_table(draw: random.Random) -> Table:
    """A scenario without events and without [recovery]; valid, and fit to run."""
    n, p = draw.choices((1, 2, 3), (2, 5, 1))[0], draw.choices((1, 2), (4, 1))[0]
    lanes = draw.choice((1, 1, 1, 2, 3, 5))
    table: Table = {
        "name": "faults",
        "steps": draw.randint(16, 32),
        "lanes": lanes,
        "seed": draw.randrange(2**31),
        "record": "all",
        "bounds": draw.random() < 0.7,
        "system": _system(draw, n, p),
        "links": _links(draw),
        "transport": {"lanes_per_packet": draw.choice((lanes, lanes, (lanes + 1) // 2, 1 + lanes // 3))},
        "actuator": {"on_loss": draw.choices(("zero", "hold"), (4, 1))[0]},
    }
    if draw.random() < 0.12:
        table["uncertainty"] = {"dA": [_matrix(draw, n, n, 0.1)], "delta": round(draw.uniform(0.05, 0.5), 2)}
    if draw.random() < 0.3:
        table["clock"] = {"window": draw.randint(1, 12)}
    table["input"] = {"kind": "sine", "amplitude": 2.0, "period": 7.0}
    table["estimators"] = [new_estimator(draw, table, name) for name in ("a", "b", "c")[: draw.choice((1, 2, 2, 3))]]
    other = {**table, "input": _input(draw, table, n)}
    return other if _fits(other) else table


def new_estimator(draw: random.Random, table: Table, name: str, *, acks: str | None = None) -> Table:
    """An estimator of any kind that can run in a scenario; acks: what it is to be told, where that is given."""
    for _ in range(_TRIES):
        kind = draw.choices(CHEAP, _WEIGHTS)[0]
        spec: Table = {"name": name, "kind": kind, **OPTIONS.get(kind, {})}
        if acks is not None:
            spec["acks"] = acks
        elif kind in _NEEDS_ACKS:
            spec["acks"] = "perfect"
        elif draw.random() < 0.4:
            spec["acks"] = draw.choice(("none", "perfect"))
        if kind == "oe":
            spec["until"] = _OE_UNTIL
        elif draw.random() < 0.1 and acks is None:
            spec["until"] = draw.randint(1, table["steps"])
        if draw.random() < 0.2:
            spec["buffer"] = draw.randint(0, 4)
        if _fits({**table, "estimators": [spec]}):
            return spec
    kind = "gpb1" if table["actuator"]["on_loss"] == "hold" else "aoe"
    spec = {"name": name, "kind": kind, "acks": acks or "none"}
    return spec


def _fits(table: Table) -> bool:
    try:
        check_parts(parse_scenario(table))
    except UsageError:
        return False
    return True


def _system(draw: random.Random, n: int, p: int) -> Table:
    """Mildly unstable at most: tr P stays far from what rounding would blur."""
    A = _matrix(draw, n, n, 0.3)
    for i in range(n):
        A[i][i] = round(draw.choice((0.3, 0.7, 0.9, 1.0, 1.05)) + draw.uniform(-0.05, 0.05), 3)
        for j in range(i):
            A[i][j] = 0.0
    C = _matrix(draw, p, n, 0.6)
    for i in range(p):
        C[i][i % n] = 1.0
    return {
        "A": A,
        "B": [[round(draw.uniform(0.3, 1.0) * draw.choice((-1, 1)), 3)] for _ in range(n)],
        "C": C,
        "Q": _covariance(draw, n),
        "R": _covariance(draw, p),
        "x0_mean": [round(draw.uniform(-2, 2), 2) for _ in range(n)],
        "P0": _covariance(draw, n),
    }


def _matrix(draw: random.Random, rows: int, columns: int, size: float) -> list[list[float]]:
    return [[round(draw.uniform(-size, size), 3) for _ in range(columns)] for _ in range(rows)]


def _covariance(draw: random.Random, n: int) -> list[list[float]]:
    return [[round(draw.uniform(0.2, 2.0), 3) if i == j else 0.05 for j in range(n)] for i in range(n)]


def _input(draw: random.Random, table: Table, n: int) -> Table:
    followed = [spec["name"] for spec in table["estimators"] if "until" not in spec]
    kind = draw.choices(("sine", "uniform", "exponential", "constant", "feedback", "pid", "lqg"), (3, 2, 1, 1, 1, 1, 1))
    tables: dict[str, Table] = {
        "sine": {"amplitude": 3.0, "period": round(draw.uniform(3, 20), 1)},
        "uniform": {"low": -2.0, "high": 1.5},
        "exponential": {"amplitude": 4.0, "tau": 9.0},
        "constant": {"value": [round(draw.uniform(-1, 1), 2)]},
    }
    if kind[0] in tables or not followed:
        kind = kind if kind[0] in tables else ["sine"]
        return {"kind": kind[0], **tables[kind[0]]}
    closed: dict[str, Table] = {
        "feedback": {"gain": _matrix(draw, 1, n, 0.4), "low": -5.0, "high": 5.0},
        "pid": {"output": _matrix(draw, 1, n, 1.0), "kp": 0.1, "ki": 0.02, "kd": 0.05, "low": -5.0, "high": 5.0},
        "lqg": {"Qx": _covariance(draw, n), "Ru": [[1.0]]},
    }
    return {"kind": kind[0], "estimator": draw.choice(followed), **closed[kind[0]]}


def loss(draw: random.Random) -> Table:
    """Any law of losses."""
    some = round(draw.uniform(0.1, 0.6), 2)
    word = "".join(draw.choices("011", k=draw.randint(3, 12))) + "1"
    return draw.choice(
        [
            {"kind": "bernoulli", "arrival": round(draw.uniform(0.4, 0.95), 2)},
            {"kind": "markov", "recovery": round(draw.uniform(0.3, 0.9), 2), "failure": some},
            {"kind": "gilbert-elliott", "to_bad": some, "to_good": 0.5, "loss_good": 0.05, "loss_bad": 0.8},
            {"kind": "four-state", "to_burst": 0.2, "to_good": 0.5, "to_pause": 0.2, "from_pause": 0.5},
            {"kind": "scripted", "pattern": word, "assumed": {"kind": "bernoulli", "arrival": 0.7}},
            {"kind": "none"},
        ]
    )


def _links(draw: random.Random) -> Table:
    links: Table = {name: _link(draw) for name in ("control", "observation")}
    if "delay" not in links["observation"] and "transport" not in links["observation"] and draw.random() < 0.15:
        links["observation"] = {"loss": loss(draw), "on_loss": "noise"}
    mode = draw.choice(("none", "perfect", "link", "link"))
    links["ack"] = {"mode": mode}
    if mode == "link":
        links["ack"] |= _link(draw)
        if draw.random() < 0.3:
            links["ack"]["batch"] = draw.randint(2, 4)
    return links


def _link(draw: random.Random) -> Table:
    """A link without time, or one with; where estimators would have to sample its law they are told one."""
    link: Table = {"loss": loss(draw)}
    if draw.random() < 0.6:
        return link
    link["assumed"] = {"kind": "markov", "recovery": 0.7, "failure": 0.2}
    if "assumed" in link["loss"]:
        del link["loss"]["assumed"]
        link["loss"]["assumed"] = link["assumed"]
    link["delay"] = draw.choice(
        [
            {"kind": "constant", "by": "4 ms"},
            {"kind": "uniform", "low": "0 s", "high": "35 ms"},
            {"kind": "normal", "mean": "8 ms", "std": "6 ms", "in_order": True},
            {"kind": "log-normal", "median": "6 ms", "sigma": 0.7},
        ]
    )
    if draw.random() < 0.3:
        link["rate"] = {"bits_per_second": 40000.0, "queue_packets": draw.randint(2, 5)}
    if draw.random() < 0.3:
        link["reorder"] = {"chance": 0.2, "by": "12 ms"}
    if draw.random() < 0.3:
        link["duplicate"] = {"chance": 0.2, "after": "3 ms"}
    if draw.random() < 0.2:
        link["corrupt"] = {"chance": 0.1}
    if draw.random() < 0.4:
        tcp = {"kind": "tcp", "congestion": draw.choice(("cubic", "reno"))}
        link["transport"] = draw.choice([{"kind": "udp"}, {"kind": "udp", "late": "deliver"}, tcp])
    if draw.random() < 0.2 and link["loss"]["kind"] in ("markov", "gilbert-elliott"):
        link |= {"clock": "time", "slot": draw.choice(("4 ms", "10 ms"))}
    return link
