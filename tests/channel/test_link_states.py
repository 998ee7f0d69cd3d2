"""Any link goes on from its state after any step: the same fates, contents and counts as if it had never stopped."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from hypothesis import HealthCheck, assume, given, settings
from hypothesis import strategies as st

from orchestrator.resuming import Life, Messages, check_resumed, live
from scenario.strategies import losses
from testbed.channel.real.service import RealLinkService
from testbed.channel.service import LinkService, builder, role_of
from testbed.errors import UsageError
from testbed.scenario import Scenario, parse_scenario
from testbed.wire.codec import PacketEncoder, encode
from testbed.wire.keys import Keys, LinkName
from testbed.wire.messages import Acknowledgement, Change, Control, Observation
from testbed.wire.setup import Setup
from testbed.wire.state import pack, unpack

RUN, STEPS = "run0testrun1", 24
TYPES: dict[LinkName, Any] = {"control": Control, "observation": Observation, "ack": Acknowledgement}

delays = st.sampled_from(
    [
        {"kind": "constant", "by": "25 ms"},
        {"kind": "uniform", "low": "1 ms", "high": "45 ms"},
        {"kind": "uniform", "low": "1 ms", "high": "45 ms", "in_order": True},
        {"kind": "log-normal", "median": "8 ms", "sigma": 0.7},
    ]
)
stages: dict[str, st.SearchStrategy[Any]] = {
    "delay": delays,
    "reorder": st.just({"chance": 0.3, "by": "22 ms"}),
    "duplicate": st.just({"chance": 0.4, "after": "13 ms"}),
    "corrupt": st.just({"chance": 0.2}),
    "rate": st.sampled_from(
        [{"bits_per_second": 1.2e5, "queue_packets": 3}, {"bits_per_second": 3e5, "burst_bytes": 700}]
    ),
}
slots = st.sampled_from(["4 ms", "15 ms"])
transports = st.sampled_from(
    [
        {"kind": "udp"},
        {"kind": "udp", "mtu": 100, "late": "deliver"},
        {"kind": "tcp"},
        {"kind": "tcp", "mss": 60, "buffer_bytes": 400, "waiting_max": 3, "delayed_ack": "40 ms"},
        {"kind": "tcp", "lease": "60 ms", "blocked_limit": "30 ms", "retry": "10 ms", "buffer_bytes": 1500},
    ]
)


@st.composite
def changes(draw: st.DrawFn, timed: bool) -> list[tuple[int, dict[str, Any]]]:
    """At steps in order, some of them at one step."""
    keys = {"loss": losses, "up": st.booleans(), **(stages if timed else {})}
    at = sorted(draw(st.lists(st.integers(1, STEPS - 1), max_size=4)))
    names = [draw(st.sampled_from(sorted(keys))) for _ in at]
    return [(step, {name: draw(keys[name])}) for step, name in zip(at, names, strict=True)]


@st.composite
def cases(draw: st.DrawFn) -> tuple[LinkName, dict[str, Any], list[tuple[int, dict[str, Any]]]]:
    """A link, the tables of a scenario without its events, and its changes."""
    link: LinkName = draw(st.sampled_from(["control", "observation", "ack"]))
    timed = draw(st.booleans())
    table: dict[str, Any] = {"loss": draw(losses)}
    if timed:
        table |= draw(st.fixed_dictionaries({}, optional=stages))
        if draw(st.booleans()):
            table |= {"clock": "time", "slot": draw(slots)}
        if draw(st.booleans()):
            table["transport"] = draw(transports)
        if draw(st.booleans()):
            table["deadline"] = "4 ms"
    if link == "ack":
        table |= {"mode": "link", "batch": draw(st.integers(1, 4)) if timed else 1}
    if link == "observation" and not timed:
        table["on_loss"] = draw(st.sampled_from(["nothing", "noise"]))
    tables = {
        "steps": STEPS,
        "lanes": draw(st.integers(1, 3)),
        "seed": draw(st.integers(0, 99)),
        "transport": {"lanes_per_packet": draw(st.integers(1, 3))},
        "clock": {"period": "10 ms"},
        "system": {"A": [[1.0]], "B": [[1.0, 2.0]], "C": [[1.0], [2.0]], "Q": [[1.0]], "R": [[1.0, 0.0], [0.0, 1.0]]},
        "estimators": [{"name": "aoe", "acks": "none"}],
        "links": {link: table},
    }
    return link, tables, draw(changes(timed))


def scenario_of(tables: dict[str, Any], link: LinkName, events: list[tuple[int, dict[str, Any]]]) -> Scenario:
    return parse_scenario(
        {**tables, "events": [{"at": step, "action": "set", "link": link, "set": what} for step, what in events]}
    )


def packets(setup: Setup, link: LinkName, noise: bool) -> Messages:
    """What is sent over a link: contents that are all different."""
    rng, model = np.random.default_rng(setup.scenario.seed), TYPES[link]
    encoder, key = PacketEncoder(model, RUN, "controller" if link == "control" else "plant"), Keys(RUN).sent(link)
    out, seq = [], 0
    for step in range(model.FIRST_STEP, model.FIRST_STEP + STEPS):
        for lane, lanes in setup.blocks:
            values = rng.normal(size=(lanes, 2))
            arrays: dict[str, Any] = {"control": {"u": values}, "observation": {"y": values}, "ack": {}}[link]
            if link == "ack":
                arrays = {"nu": (values[:, 0] > 0).astype(np.uint8)}
            if noise:
                arrays = {**arrays, "noise": rng.normal(size=(lanes, 2))}
            out.append((key, encoder.encode(seq, step, lane, lanes, arrays)))
            seq += 1
    return out


@settings(max_examples=200, deadline=None, suppress_health_check=[HealthCheck.too_slow, HealthCheck.filter_too_much])
@given(case=cases(), told=st.integers(0, 4), begin=st.integers(1, STEPS))
def test_a_link_goes_on_with_the_same_fates_contents_and_counts(
    case: tuple[LinkName, dict[str, Any], list[tuple[int, dict[str, Any]]]], told: int, begin: int
) -> None:
    """Changes that came as orders while it went are in the scenario of the one that goes on."""
    link, tables, events = case
    known = max(0, len(events) - told)
    try:
        before, after = (Setup(RUN, scenario_of(tables, link, some)) for some in (events[:known], events))
    except UsageError:
        assume(False)
        return
    assume(before.scenario.takes_time(link) == after.scenario.takes_time(link))
    sent = packets(before, link, tables["links"][link].get("on_loss") == "noise")
    orders = [
        (Keys(RUN).change(link), encode(Change(run=RUN, source="orchestrator", seq=i, step=step, set=what)))
        for i, (step, what) in enumerate(events[known:])
    ]
    role = role_of(link)
    life = live(Life(builder(link)), before, role, orders + sent)
    assert len(life.published) == len(sent)
    check_resumed(life, after, role, sent, begin)


TABLES: dict[str, Any] = {
    "steps": STEPS,
    "lanes": 2,
    "system": {"A": [[1.0]], "B": [[1.0]], "C": [[1.0], [2.0]], "Q": [[1.0]], "R": [[1.0, 0.0], [0.0, 1.0]]},
    "estimators": [{"name": "aoe", "acks": "none"}],
}
LOSS = {"kind": "bernoulli", "loss": 0.2}
MESSY: dict[str, Any] = {"delay": {"kind": "uniform", "low": "1 ms", "high": "45 ms"}, "duplicate": {"chance": 0.3}}
WAYS: dict[str, dict[str, Any]] = {
    "udp": {"transport": {"kind": "udp"}, "delay": {"kind": "constant", "by": "25 ms"}},
    "fragments": {"transport": {"kind": "udp", "mtu": 100, "late": "deliver"}, **MESSY},
    "tcp": {"transport": {"kind": "tcp"}, "delay": {"kind": "constant", "by": "25 ms"}},
    "segments": {"transport": {"kind": "tcp", "mss": 60, "buffer_bytes": 400}, **MESSY},
    "waiting": {
        "transport": {"kind": "tcp", "buffer_bytes": 1448, "mss": 200},
        "delay": {"kind": "constant", "by": "70 ms"},
    },
}


@pytest.mark.parametrize("way", WAYS)
def test_contents_that_a_transport_has_on_its_way_arrive(way: str) -> None:
    tables = {**TABLES, "clock": {"period": "10 ms"}, "links": {"observation": {"loss": LOSS, **WAYS[way]}}}
    setup = Setup(RUN, parse_scenario(tables))
    sent = packets(setup, "observation", False)
    life = live(Life(builder("observation")), setup, "link.observation", sent)
    assert life.counters["late"] > 5
    for begin in range(1, STEPS + 1):
        check_resumed(life, setup, "link.observation", sent, begin)


@pytest.mark.parametrize(
    ("loss", "wrong"),
    [
        ({"kind": "markov", "recovery": 0.5, "failure": 0.5}, {"process": np.array([0, 2])}),
        ({"kind": "scripted", "pattern": "01"}, {"process": np.array([0, 1])}),
        ({"kind": "markov", "recovery": 0.5, "failure": 0.5}, {"process": np.array([0])}),
        ({"kind": "markov", "recovery": 0.5, "failure": 0.5}, {"more": np.array([0])}),
    ],
)
def test_a_state_of_another_link_is_refused(loss: dict[str, Any], wrong: dict[str, Any]) -> None:
    setup = Setup(RUN, parse_scenario({**TABLES, "links": {"control": {"loss": loss}}}))
    life = live(Life(builder("control")), setup, "link.control", packets(setup, "control", False)[:0])
    link: LinkService = life.service
    right = {"transitions": np.zeros((2, 2), dtype=np.int64)}
    numbers = {"sent": 6, "delivered": 1, "bursts": 1, "cut": 0}
    link.resume(0, 3, pack(right, step=3, changes=0, **numbers))
    assert unpack(link.state(0)).number("sent") == 6
    for arrays, step, made in ((right, 4, 0), (right, 3, 1), ({**right, **wrong}, 3, 0)):
        with pytest.raises(UsageError) as raised:
            link.resume(0, 3, pack(arrays, step=step, changes=made, **numbers))
        assert "\n" not in str(raised.value)


def test_a_link_through_sockets_gives_none() -> None:
    assert RealLinkService.gives_state.fget(RealLinkService.__new__(RealLinkService)) is False  # type: ignore[attr-defined]
