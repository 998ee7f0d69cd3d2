"""Real zenoh between the hosts."""

from __future__ import annotations

import subprocess
import sys

import pytest

from channel.kernel.ends import hosts, link

pytestmark = [pytest.mark.root, pytest.mark.processes]

_HEAD = """
import sys, time
import zenoh
config = zenoh.Config()
config.insert_json5("mode", '"peer"')
config.insert_json5("scouting/multicast/enabled", "false")
config.insert_json5(sys.argv[1] + "/endpoints", '["' + sys.argv[2] + '"]')
"""
_SUBSCRIBER = (
    _HEAD
    + """
session = zenoh.open(config)
subscriber = session.declare_subscriber("test/key", lambda sample: print(sample.payload.to_string(), flush=True))
print("ready", flush=True)
sys.stdin.read()
"""
)
_PUBLISHER = (
    _HEAD
    + """
session = zenoh.open(config)
publisher = session.declare_publisher("test/key", congestion_control=zenoh.CongestionControl.BLOCK)
while not publisher.matching_status.matching:
    time.sleep(0.01)
for number in range(int(sys.argv[3])):
    publisher.put(f"{number}")
    time.sleep(0.005)
session.close()
"""
)


@pytest.mark.parametrize("scheme", ["udp", "tcp"])
def test_messages_come_through(scheme: str) -> None:
    """Over TCP all of them and in order, though the link loses packets."""
    number = 40
    delay = {"kind": "constant", "by": "2 ms"}
    broken = link(delay=delay, loss={"kind": "bernoulli", "loss": 0.05}) if scheme == "tcp" else link(delay=delay)
    with hosts(broken, broken, congestion="reno") as pair:
        endpoint = f"{scheme}/{pair.b.address}:7447"
        pipe = subprocess.PIPE
        command = [sys.executable, "-c", _SUBSCRIBER, "listen", endpoint]
        subscriber = pair.b.popen(command, stdin=pipe, stdout=pipe, text=True)
        assert subscriber.stdout is not None
        assert subscriber.stdout.readline() == "ready\n"
        publisher = pair.a.run([sys.executable, "-c", _PUBLISHER, "connect", endpoint, str(number)], timeout=60)
        assert (publisher.returncode, publisher.stdout) == (0, "")
        got = [subscriber.stdout.readline().strip() for _ in range(number)]
        forward = pair.books()["forward"]
    assert got == [str(k) for k in range(number)]
    assert forward["delivered"] >= number
    assert (forward["dropped"] > 0) == (scheme == "tcp")
