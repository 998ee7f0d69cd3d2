"""Two hosts through the kernel: the packets of the pipeline are the packets of the wire."""

from __future__ import annotations

import csv
import hashlib
import json
import os
import shlex
import shutil
import subprocess
import sys
from collections import Counter
from pathlib import Path

import pytest

from channel.kernel.ends import (
    PACKET,
    PAYLOAD,
    PORT,
    Receiver,
    alive,
    hosts,
    link,
    network_of,
    python,
    send,
    users_of,
    wait_for,
)
from testbed.channel.kernel.hosts import Hosts, available_congestion
from testbed.channel.pipeline import Pipeline
from testbed.errors import UsageError

pytestmark = pytest.mark.root

LOSS = {"kind": "markov", "recovery": 0.4, "failure": 0.2}
_TCP_SERVER = """
import hashlib, socket, sys
with socket.create_server((sys.argv[1], int(sys.argv[2]))) as server:
    print("ready", flush=True)
    end, _ = server.accept()
    digest = hashlib.sha256()
    while data := end.recv(65536):
        digest.update(data)
    print(end.getsockopt(socket.IPPROTO_TCP, socket.TCP_CONGESTION, 16).rstrip(b"\\0").decode())
    print(digest.hexdigest())
    end.close()
"""
_TCP_CLIENT = """
import socket, sys
with socket.create_connection((sys.argv[1], int(sys.argv[2]))) as end:
    print(end.getsockopt(socket.IPPROTO_TCP, socket.TCP_CONGESTION, 16).rstrip(b"\\0").decode())
    end.sendall(bytes(i * i % 251 for i in range(int(sys.argv[3]))))
    end.shutdown(socket.SHUT_WR)
    end.recv(1)
"""


def arrivals(impairments: dict[str, object], number: int, seed: int = 7) -> Counter[int]:
    """How many intact copies of each packet the pipeline alone would let arrive."""
    pipeline = Pipeline(link(**impairments), seed, "link.observation")
    intact = {k: sum(copy.flip is None for copy in pipeline.send(PACKET, k)) for k in range(number)}
    return +Counter(intact)


def _datagram(pair: Hosts, number: int, size: int = PAYLOAD) -> None:
    """One from a to b, in the pipeline when this returns."""
    script = (
        f"import socket; socket.socket(2, 2).sendto(({number}).to_bytes(4, 'big').ljust({size}), ('10.0.0.2', {PORT}))"
    )
    assert pair.a.run(python(script)).returncode == 0
    wait_for(lambda: pair.books()["forward"]["sent"])


def test_the_wire_loses_duplicates_and_corrupts_the_packets_of_the_pipeline() -> None:
    settings = {"loss": LOSS, "duplicate": {"chance": 0.1, "after": "1 ms"}, "corrupt": {"chance": 0.1}}
    number = 1500
    expected = arrivals(settings, number)
    with hosts(link(**settings)) as pair:
        receiver = Receiver(pair.b)
        send(pair, number)
        got = receiver.counts()
        books = pair.books()
    assert got == expected
    assert 0 < sum(expected.values()) < number
    forward = books["forward"]
    assert forward["sent"] == number
    assert forward["sent"] + forward["duplicated"] == forward["delivered"] + forward["dropped"] + forward["in_flight"]
    assert forward["in_flight"] == forward["overrun"] == 0
    assert sum(got.values()) == forward["delivered"] - forward["corrupted"]
    assert books["backward"]["sent"] == 0


def test_trace_has_every_packet_with_its_delay(tmp_path: Path) -> None:
    settings = {"loss": LOSS, "delay": {"kind": "constant", "by": "20 ms"}}
    with hosts(link(**settings), trace=tmp_path / "t.csv") as pair:
        Receiver(pair.b)
        send(pair, 300)
    with (tmp_path / "t.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert sorted(int(row["seq"]) for row in rows) == list(range(300))
    delays = {int(row["seq"]): int(row["delivered_ns"]) - int(row["sent_ns"]) for row in rows if row["delivered_ns"]}
    assert set(delays) == set(arrivals({"loss": LOSS}, 300))
    assert all(delay >= 20_000_000 for delay in delays.values())


def test_what_is_in_flight_at_the_end_is_counted_and_traced(tmp_path: Path) -> None:
    with hosts(link(delay={"kind": "constant", "by": "10 min"}), trace=tmp_path / "t.csv") as pair:
        _datagram(pair, 0)
    books = pair.books()["forward"]
    assert (books["sent"], books["delivered"], books["in_flight"]) == (1, 0, 1)
    seq, sent_ns, delivered_ns = (tmp_path / "t.csv").read_text().splitlines()[1].split(",")
    assert (int(seq), int(delivered_ns) - int(sent_ns)) == (0, 600 * 10**9)


def test_change_keeps_the_draws_and_what_is_in_flight() -> None:
    late = {"delay": {"kind": "constant", "by": "500 ms"}}
    lossy = {"loss": {"kind": "bernoulli", "loss": 0.5}}
    with hosts(link(**late)) as pair:
        receiver = Receiver(pair.b)
        _datagram(pair, 2**20)
        pair.change("forward", link(**lossy))
        send(pair, 400, first=1)
        got = receiver.counts()
    expected = arrivals(lossy, 401)
    assert set(got) == set(expected) - {0} | {2**20}


def test_packets_larger_than_the_mtu_travel_in_fragments() -> None:
    """10 kB of UDP: 7 fragments at an MTU of 1500."""
    with hosts(link()) as pair:
        receiver = Receiver(pair.b)
        _datagram(pair, 5, 10_000)
        assert receiver.counts() == {5: 1}
    assert pair.books()["forward"]["sent"] == 7


@pytest.mark.parametrize("congestion", available_congestion())
def test_tcp_comes_through_intact_with_the_congestion_control_asked_for(congestion: str) -> None:
    broken = link(
        loss={"kind": "bernoulli", "loss": 0.05}, corrupt={"chance": 0.02}, delay={"kind": "constant", "by": "1 ms"}
    )
    size = 300_000
    with hosts(broken, broken, congestion=congestion) as pair:
        server = pair.b.popen(python(_TCP_SERVER, pair.b.address, PORT), stdout=-1, text=True)
        assert server.stdout is not None
        assert server.stdout.readline() == "ready\n"
        client = pair.a.run(python(_TCP_CLIENT, pair.b.address, PORT, size), timeout=90)
        assert (client.returncode, client.stdout.split()) == (0, [congestion])
        used, digest = server.communicate(timeout=90)[0].split()
    assert used == congestion
    assert digest == hashlib.sha256(bytes(i * i % 251 for i in range(size))).hexdigest()
    assert pair.books()["forward"]["dropped_loss"] > 0
    assert pair.books()["forward"]["corrupted"] > 0


def test_hosts_may_differ_in_congestion_control_and_an_unknown_one_is_refused() -> None:
    with pytest.raises(UsageError, match=r"congestion: got 'renno'; allowed: .*reno.*; did you mean 'reno'\?"):
        hosts(link(), congestion="renno")
    with hosts(link(), congestion={"b": "reno"}) as pair:
        server = pair.b.popen(python(_TCP_SERVER, pair.b.address, PORT), stdout=-1, text=True)
        assert server.stdout is not None
        assert server.stdout.readline() == "ready\n"
        default = pair.a.run(["cat", "/proc/sys/net/ipv4/tcp_congestion_control"]).stdout.strip()
        assert pair.a.run(python(_TCP_CLIENT, pair.b.address, PORT, 10), timeout=30).stdout.split() == [default]
        assert server.communicate(timeout=30)[0].split()[0] == "reno"


def test_nothing_is_left_after_an_exception() -> None:
    """Not a child of a child, nor one that does not end when asked, nor the namespaces."""
    networks, processes = [], []
    pair = hosts(link())

    def fails() -> None:
        with pair:
            networks.extend(network_of(host) for host in (pair.a, pair.b))
            for script in ("sleep 1000 & echo $!; wait", "trap '' TERM; echo $$; while :; do sleep 0.05; done"):
                shell = pair.a.popen(["sh", "-c", script], stdout=-1, text=True)
                assert shell.stdout is not None
                processes.append((shell, int(shell.stdout.readline())))
            raise ZeroDivisionError

    with pytest.raises(ZeroDivisionError):
        fails()
    assert len(set(networks)) == 2
    assert [users_of(network) for network in networks] == [[], []]
    assert networks[0] not in Path("/proc/self/mountinfo").read_text()
    assert not any(alive(pid) for _, pid in processes)
    assert processes[0][0].poll() is not None
    assert processes[1][0].poll() == -9
    assert ["trap" in command for command in pair.stubborn] == [True]
    with pytest.raises(UsageError, match="the hosts are closed"):
        pair.a.popen(["true"])


def test_commands_that_are_not_there_and_sizes_that_cannot_be() -> None:
    with hosts(link()) as pair, pytest.raises(UsageError, match="no-such-program: no such command"):
        pair.a.popen(["no-such-program"])
    with pytest.raises(UsageError, match="mtu: got 100; allowed: 576 … 65535"):
        hosts(link(), mtu=100)


def test_another_terminal_finds_the_way_in() -> None:
    if shutil.which("nsenter") is None:
        pytest.skip("there is no command nsenter")
    with hosts(link()) as pair:
        for host in (pair.a, pair.b):
            command = [*shlex.split(pair.entrances[host.name]), "readlink", "/proc/self/ns/net"]
            found = subprocess.run(command, capture_output=True, text=True, timeout=30, check=True).stdout.strip()
            assert found == network_of(host)


def test_without_rights_user_namespaces_will_do(tmp_path: Path) -> None:
    """The same in a process that has given its rights up."""
    script = tmp_path / "owner.py"
    script.write_text(
        "import json\n"
        "from channel.kernel.ends import Receiver, hosts, link, send\n"
        "from testbed.channel.kernel.namespaces import privileged\n"
        f"with hosts(link(loss={LOSS!r})) as pair:\n"
        "    receiver = Receiver(pair.b)\n"
        "    send(pair, 200)\n"
        "    print(json.dumps([privileged(), sorted(receiver.counts())]))\n"
    )
    unprivileged = ["setpriv", "--bounding-set", "-all,+setfcap", "--inh-caps", "-all"]
    if subprocess.run([*unprivileged, "unshare", "-U", "true"], capture_output=True, check=False).returncode:
        pytest.skip("no setpriv, or no user namespaces")
    environment = {**os.environ, "PYTHONPATH": ":".join(sys.path)}
    done = subprocess.run(
        [*unprivileged, sys.executable, str(script)],
        env=environment,
        capture_output=True,
        text=True,
        timeout=60,
        check=False,
    )
    assert done.stderr == ""
    assert json.loads(done.stdout) == [False, sorted(arrivals({"loss": LOSS}, 200))]
