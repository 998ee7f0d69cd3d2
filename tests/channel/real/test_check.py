"""What real links cannot do is refused before anything starts, in one line."""

from __future__ import annotations

from typing import Any

import pytest

from orchestrator.runs import BERNOULLI, MARKOV, scenario
from testbed.channel.kernel.doctor import Finding
from testbed.channel.real import check
from testbed.errors import UsageError
from testbed.scenario.backend import real_links, with_backend

INDEPENDENT = {"control": {"loss": BERNOULLI}, "observation": {"loss": BERNOULLI}}
TCP = {"kind": "tcp"}


def links(**observation: Any) -> dict[str, Any]:
    return {"control": {"loss": BERNOULLI}, "observation": {"backend": "relay", **observation}}


@pytest.mark.parametrize(
    ("observation", "per_packet", "reason"),
    [
        (
            {"transport": TCP, "loss": BERNOULLI},
            None,
            "links.observation: backend 'relay' with transport 'tcp': loss: ",
        ),
        ({"transport": TCP, "back": {"loss": BERNOULLI}}, None, "transport 'tcp': loss: got 'bernoulli'"),
        ({"loss": MARKOV}, 2, "links.observation: backend 'relay' with several packets a step"),
        ({"rate": {"bits_per_second": 1e6}}, 2, "several packets a step"),
        ({"loss": {"kind": "scripted", "lost": [3]}}, 2, "several packets a step"),
    ],
)
def test_refusals(observation: dict[str, Any], per_packet: int | None, reason: str) -> None:
    transport = {} if per_packet is None else {"transport": {"lanes_per_packet": per_packet}}
    given = scenario(links=links(**observation), estimators=[{"name": "aoe"}], **transport)
    with pytest.raises(UsageError) as caught:
        check.check_links(given)
    assert reason in str(caught.value)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("observation", "per_packet"),
    [
        ({"loss": MARKOV}, None),
        ({"loss": MARKOV}, 6),
        ({"loss": MARKOV, "assumed": BERNOULLI}, 2),
        ({"loss": MARKOV, "clock": "time", "slot": "10 ms"}, 2),
        ({"loss": BERNOULLI}, 1),
        ({"transport": TCP, "delay": {"kind": "constant", "by": "3 ms"}}, None),
    ],
)
def test_allowed(observation: dict[str, Any], per_packet: int | None) -> None:
    transport = {} if per_packet is None else {"transport": {"lanes_per_packet": per_packet}}
    check.check_links(scenario(links=links(**observation), estimators=[{"name": "aoe"}], **transport))


def test_the_kernel_backend_says_what_the_machine_lacks(monkeypatch: pytest.MonkeyPatch) -> None:
    lacks = Finding("hosts, backend tun", False, "/dev/net/tun: permission denied", "modprobe tun")
    monkeypatch.setattr("testbed.channel.kernel.doctor.can_make_hosts", lambda: lacks)
    with pytest.raises(UsageError, match=r"links\.control\.backend: .*permission denied.*modprobe tun.*relay"):
        check.check_links(with_backend(scenario(links=INDEPENDENT, estimators=[{"name": "aoe"}]), "kernel"))


@pytest.mark.parametrize(("mode", "expected"), [("none", 2), ("perfect", 2), ("link", 3)])
def test_with_backend_changes_every_link_that_carries_packets(mode: str, expected: int) -> None:
    given = scenario(links={**INDEPENDENT, "ack": {"mode": mode}})
    over = with_backend(given, "relay")
    assert len(real_links(over)) == expected
    assert real_links(given) == []
    assert with_backend(over, "model") == given


def test_noise_in_place_of_a_lost_observation_needs_the_model() -> None:
    given = scenario(links={"observation": {"loss": BERNOULLI, "on_loss": "noise"}}, estimators=[{"name": "aoe"}])
    with pytest.raises(UsageError, match="a real backend"):
        with_backend(given, "relay")
