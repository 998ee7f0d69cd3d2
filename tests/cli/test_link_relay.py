"""``testbed link relay``."""

from __future__ import annotations

import json
import signal
import socket
import subprocess
import sys
from contextlib import closing
from pathlib import Path

import pytest

from channel.sockets.ends import datagram, number_of, udp_socket
from cli.commands import Command, testbed, write
from testbed.scenario.trace_file import read_fates

__all__ = ["testbed"]
UDP = ("--listen", "udp/127.0.0.1:0", "--to", "udp/127.0.0.1:7447")
TCP = ("--listen", "tcp/127.0.0.1:0", "--to", "tcp/127.0.0.1:7447")


@pytest.mark.processes
def test_it_relays_until_interrupted_with_the_fates_of_link_sample(testbed: Command, tmp_path: Path):
    """The same component and seed: sample, in simulated time, is what the relay does to the same packets."""
    testbed("link", "sample", "s.toml", "--link", "observation", "-n", 300, "--out", "sampled.csv")
    expected = read_fates(Path("sampled.csv")).arrived.tolist()
    while not expected[-1]:  # when the last one has arrived, all were read
        expected.pop()
    with closing(udp_socket()) as target:
        command = [sys.executable, "-m", "testbed", "link", "relay", "s.toml", "--link", "observation", "--json"]
        command += ["--listen", "udp/127.0.0.1:0", "--to", f"udp/127.0.0.1:{target.getsockname()[1]}"]
        command += ["--trace", "relayed.csv"]
        process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
        try:
            assert process.stderr is not None
            port = int(process.stderr.readline().split(" to ")[0].rsplit(":", 1)[1])
            with closing(udp_socket(("127.0.0.1", port))) as client:
                for number in range(len(expected)):
                    client.send(datagram(number))
                arrived = [number_of(target.recv(100)) for _ in range(sum(expected))]
            process.send_signal(signal.SIGINT)
            out, err = process.communicate(timeout=20)
        finally:
            process.kill()
            process.wait(20)
    assert (process.returncode, err) == (0, "")
    books = json.loads(out)
    assert arrived == [number for number, arrives in enumerate(expected) if arrives]
    assert read_fates(Path("relayed.csv")).arrived.tolist() == expected
    forward = books["forward"]
    assert forward["sent"] == len(expected) == forward["delivered"] + forward["dropped_loss"]
    assert books["backward"]["sent"] == books["kernel_dropped"] == 0


def test_the_table_has_both_directions_and_what_is_around(testbed: Command):
    outcome = testbed(
        "link", "relay", "s.toml", "--link", "control", "--back", "observation", *UDP, "--duration", "1 ms"
    )
    assert outcome.code == 0
    head, forward, backward, around = outcome.out.splitlines()
    assert head.split() == ["sent", "delivered", "dropped", "duplicated", "corrupted", "in", "flight"]
    assert (forward.split()[0], backward.split()[0]) == ("forward", "backward")
    assert around.startswith("clients 0, replaced 0, refused 0, unreachable 0, kernel dropped 0, overdue 0; ")
    assert outcome.err.startswith("control: udp/127.0.0.1:")


def test_a_tcp_link_takes_stalls_and_resets(testbed: Command, tmp_path: Path):
    write(tmp_path / "slow.toml", links={"control": {"delay": {"kind": "constant", "by": "1 ms"}}})
    options = ("--duration", "20 ms", "--reset", "1 ms + 1 ms", "--stall", "0 s + 1 ms", "--json")
    outcome = testbed("link", "relay", "slow.toml", "--link", "control", *TCP, *options)
    assert outcome.code == 0, outcome.err
    assert json.loads(outcome.out)["resets"] == 0


def test_it_says_so_where_others_can_reach_it(testbed: Command):
    anywhere = ("--listen", "udp/0.0.0.0:0", "--to", "udp/127.0.0.1:7447", "--duration", "1 ms")
    outcome = testbed("link", "relay", "s.toml", "--link", "control", *anywhere)
    assert outcome.code == 0
    assert "may be reached from other machines" in outcome.err


def test_a_link_whose_transport_is_tcp_needs_tcp_endpoints_and_its_back_is_the_way_back(
    testbed: Command, tmp_path: Path
):
    lossy_back = {"transport": {"kind": "tcp"}, "back": {"loss": {"kind": "bernoulli", "loss": 0.5}}}
    write(tmp_path / "tcp.toml", links={"control": lossy_back})
    over_udp = testbed("link", "relay", "tcp.toml", "--link", "control", *UDP)
    assert (over_udp.code, over_udp.out) == (2, "")
    assert "the link has transport 'tcp'; allowed: an endpoint of tcp/" in over_udp.err
    over_tcp = testbed("link", "relay", "tcp.toml", "--link", "control", *TCP)
    assert (over_tcp.code, over_tcp.out) == (2, "")
    assert "loss: got 'bernoulli'; a TCP proxy" in over_tcp.err


def test_it_says_that_events_are_left_out(testbed: Command, tmp_path: Path):
    events = [{"at": 5, "action": "set", "link": "control", "set": {"loss": {"arrival": 0.1}}}]
    write(tmp_path / "events.toml", events=events)
    outcome = testbed("link", "relay", "events.toml", "--link", "control", *UDP, "--duration", "1 ms")
    assert outcome.code == 0, outcome.err
    assert "control: the events of the scenario are left out" in outcome.err


@pytest.mark.parametrize(
    ("options", "text"),
    [
        (("--link", "obs", *UDP), "--link obs: no such link; allowed: control, observation, ack; did you mean"),
        (("--link", "control", "--back", "ack", *UDP), "--back ack: the scenario has none"),
        (("--link", "control", *TCP), "loss: got 'bernoulli'; a TCP proxy carries bytes"),
        (("--link", "control", *UDP[:2], *TCP[2:]), "allowed with --listen udp/127.0.0.1:0: an endpoint of udp/"),
        (("--link", "control", "--listen", "tpc/h:1", *UDP[2:]), "got 'tpc'; allowed: udp/HOST:PORT or tcp/HOST:PORT"),
        (("--link", "control", "--listen", "udp/h:65536", *UDP[2:]), "--listen udp/h:65536: not an endpoint"),
        (("--link", "control", *UDP, "--duration", "1"), "--duration 1: allowed: a duration such as '10 s'"),
        (("--link", "control", *UDP, "--stall", "1 s + 1 s"), "--stall: allowed with tcp/ endpoints only"),
        (("--link", "control", *TCP, "--reset", "1 s"), "--reset 1 s: when and for how long is not clear"),
        (("--link", "control", *UDP, "--trace", "none/t.csv"), "cannot write none/t.csv"),
    ],
)
def test_wrong_input_is_refused_in_one_line(testbed: Command, options: tuple[str, ...], text: str):
    outcome = testbed("link", "relay", "s.toml", *options)
    assert (outcome.code, outcome.out) == (2, "")
    assert text in outcome.err
    assert outcome.err.count("\n") == 1


def test_a_port_in_use_is_refused(testbed: Command, tmp_path: Path):
    write(tmp_path / "clean.toml", links=None)
    with closing(socket.create_server(("127.0.0.1", 0))) as other:
        at = f"tcp/127.0.0.1:{other.getsockname()[1]}"
        outcome = testbed("link", "relay", "clean.toml", "--link", "control", "--listen", at, *TCP[2:])
    assert (outcome.code, outcome.err) == (2, f"testbed: cannot listen on {at}: address already in use\n")
