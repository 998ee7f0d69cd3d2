"""The words for ``tc netem``, and the hosts that it would work between."""

from __future__ import annotations

import shutil
from typing import Any

import pytest

from channel.kernel.ends import Receiver, hosts, link, send
from testbed.channel.kernel.doctor import examine
from testbed.channel.kernel.netem import netem_arguments
from testbed.errors import UsageError

GE = {"kind": "gilbert-elliott", "to_bad": 0.02, "to_good": 0.25, "loss_good": 0.001, "loss_bad": 0.7}

FOUR = {"kind": "four-state", "to_burst": 0.02, "to_good": 0.4, "to_pause": 0.3, "from_pause": 0.5, "to_isolated": 0.01}


@pytest.mark.parametrize(
    ("settings", "words"),
    [
        ({}, ""),
        ({"delay": {"kind": "constant", "by": "0 s"}}, ""),
        ({"loss": {"kind": "bernoulli", "loss": 0.05}}, "limit 1000000 loss random 5%"),
        (
            {"loss": {"kind": "markov", "recovery": 0.25, "failure": 0.02}},
            "limit 1000000 loss gemodel 2% 25% 100% 0%",
        ),
        ({"loss": GE}, "limit 1000000 loss gemodel 2% 25% 70% 0.1%"),
        ({"loss": {**GE, "start_good": 1.0}}, "limit 1000000 loss gemodel 2% 25% 70% 0.1%"),
        ({"loss": FOUR}, "limit 1000000 loss state 2% 40% 30% 50% 1%"),
        ({"delay": {"kind": "constant", "by": "2.5 ms"}}, "limit 1000000 delay 2500000ns"),
        ({"delay": {"kind": "uniform", "low": "0 s", "high": "30 ms"}}, "limit 1000000 delay 15000000ns 15000000ns"),
        (
            {"delay": {"kind": "normal", "mean": "10 ms", "std": "1 ms"}},
            "limit 1000000 delay 10000000ns 1000000ns distribution normal",
        ),
        ({"duplicate": {"chance": 0.01}}, "limit 1000000 duplicate 1%"),
        ({"corrupt": {"chance": 0.001}}, "limit 1000000 corrupt 0.1%"),
        ({"reorder": {"chance": 0.01, "by": "20 ms"}}, "limit 1000000 delay 20000000ns reorder 99%"),
        (
            {"rate": {"bits_per_second": 1e6, "queue_packets": 14, "overhead_bytes": 28}},
            "limit 14 rate 1000000bit 28",
        ),
        (
            {"loss": {"kind": "bernoulli", "loss": 0.2}, "delay": {"kind": "constant", "by": "1 ms"},
             "duplicate": {"chance": 0.5}, "corrupt": {"chance": 0.25}, "rate": {"bits_per_second": 5e5}},
            "limit 1000000 loss random 20% delay 1000000ns duplicate 50% corrupt 25% rate 500000bit",
        ),
    ],
)  # fmt: skip
def test_words(settings: dict[str, Any], words: str) -> None:
    assert netem_arguments(link(**settings)) == words.split()


@pytest.mark.parametrize(
    ("settings", "key"),
    [
        ({"loss": GE, "clock": "time", "slot": "10 ms"}, "clock"),
        ({"loss": {"kind": "markov", "recovery": 0.5, "failure": 0.1, "start": 0.5}}, "loss.start"),
        ({"loss": {**GE, "start_good": 0.0}}, "loss.start_good"),
        ({"loss": {**FOUR, "start": [1.0, 0.0, 0.0, 0.0]}}, "loss.start"),
        ({"loss": {"kind": "scripted", "lost": [3]}}, "loss.kind"),
        ({"delay": {"kind": "log-normal", "median": "5 ms", "sigma": 0.5}}, "delay.kind"),
        ({"delay": {"kind": "table", "values": [1.0, 2.0]}}, "delay.kind"),
        ({"delay": {"kind": "uniform", "low": "1 ms", "high": "2 ms", "in_order": True}}, "delay.in_order"),
        ({"delay": {"kind": "normal", "mean": "1 ms", "std": "1 ms"}}, "delay"),
        ({"duplicate": {"chance": 0.1, "after": "1 ms"}}, "duplicate.after"),
        ({"reorder": {"chance": 0.1, "by": "1 ms"}, "delay": {"kind": "constant", "by": "1 ms"}}, "reorder"),
        ({"rate": {"bits_per_second": 1e6, "burst_bytes": 3000}}, "rate.burst_bytes"),
        ({"rate": {"bits_per_second": 1e6, "queue_bytes": 3000}}, "rate.queue_bytes"),
        (
            {"rate": {"bits_per_second": 1e6, "queue_packets": 3}, "delay": {"kind": "constant", "by": "1 ms"}},
            "rate.queue_packets",
        ),
    ],
)
def test_what_netem_cannot_say_is_refused_before_anything_starts(settings: dict[str, Any], key: str) -> None:
    with pytest.raises(UsageError, match=rf"^backend netem: {key}: got .*; allowed: .*; backend tun can do it$"):
        hosts(link(**settings), backend="netem")


def test_it_never_speaks_of_correlation() -> None:
    """After a share, netem would read a bare further percentage as its correlation."""
    words = netem_arguments(link(loss={"kind": "bernoulli", "loss": 0.05}, corrupt={"chance": 0.1}))
    shares = [place for place, word in enumerate(words) if word.endswith("%")]
    assert all(not words[place + 1 :] or not words[place + 1].endswith("%") for place in shares)


@pytest.mark.root
def test_hosts_with_a_namespace_between_them() -> None:
    """Without impairments, so that it needs no netem."""
    _need_tools()
    with hosts(link(), backend="netem", congestion="reno") as pair:
        receiver = Receiver(pair.b)
        send(pair, 200)
        assert receiver.counts() == dict.fromkeys(range(200), 1)
        forward = pair.books()["forward"]
        assert (forward["sent"], forward["delivered"], forward["dropped"]) == (200, 200, 0)
        assert "congctl reno" in pair.a.run(["ip", "route"]).stdout
        with pytest.raises(UsageError, match="cannot be changed while it runs"):
            pair.change("forward", link())


@pytest.mark.root
def test_netem_loses_on_the_way_to_the_receiver() -> None:
    finding = next(finding for finding in examine() if finding.what == "hosts, backend netem")
    if not finding.ok:
        with pytest.raises(UsageError, match="no hosts on this machine: netem: "):
            hosts(link(loss={"kind": "bernoulli", "loss": 0.3}), backend="netem").__enter__()
        pytest.skip(f"netem: {finding.found}")
    with hosts(link(loss={"kind": "bernoulli", "loss": 0.3}), backend="netem") as pair:
        receiver = Receiver(pair.b)
        send(pair, 2000)
        got = receiver.counts()
        forward = pair.books()["forward"]
    assert forward["sent"] == forward["delivered"] + forward["dropped"] == 2000
    assert len(got) == forward["delivered"]
    assert 450 < forward["dropped"] < 750  # 600 ± 7 standard deviations


def _need_tools() -> None:
    for tool in ("ip", "tc"):
        if shutil.which(tool) is None:
            pytest.skip(f"there is no command {tool}")
