"""The two ends of a link that is compared with its model: real zenoh, a message each period, each with its number.

Both are told the time of the first message, by the machine's monotonic clock. A message's delay is counted from the
time at which it was due, as in the model: a put that blocks delays those behind it.
"""

from __future__ import annotations

import argparse
import json
import os
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from typing import Any

import zenoh

_KEY = "bench/fidelity"
_NUMBER_BYTES = 8
_NAP_S = 0.01


def urgent() -> bool:
    """Real-time priority for this thread and those it starts, so that others' work does not count as delay."""
    with suppress(OSError):
        os.sched_setscheduler(0, os.SCHED_RR, os.sched_param(1))
    return os.sched_getscheduler(0) == os.SCHED_RR


@contextmanager
def _session(side: str, endpoint: str) -> Iterator[zenoh.Session]:
    config = zenoh.Config()
    settings: dict[str, Any] = {
        "mode": "peer",
        "listen/endpoints": [],
        "connect/endpoints": [],
        f"{side}/endpoints": [endpoint],
        "scouting/multicast/enabled": False,
        "scouting/gossip/enabled": False,
        "transport/shared_memory/enabled": False,  # else large messages do not take the link
    }
    for path, value in settings.items():
        config.insert_json5(path, json.dumps(value))
    with zenoh.open(config) as session:
        yield session


def receive(endpoint: str, messages: int) -> None:
    """Prints the numbers and the times (ns) of what arrives between the two times that it is told, if not all did."""
    at_ns: dict[int, int] = {}
    complete = threading.Event()

    def take(sample: zenoh.Sample) -> None:
        now_ns = time.monotonic_ns()
        number = int.from_bytes(sample.payload.to_bytes()[:_NUMBER_BYTES], "little")
        at_ns.setdefault(number, now_ns)
        if len(at_ns) == messages:
            complete.set()

    with _session("listen", endpoint) as session:
        session.declare_subscriber(_KEY, zenoh.handlers.Callback(take, indirect=False))
        print("ready", flush=True)
        until_ns = int(sys.stdin.readline().split()[1])
        complete.wait(max(0, until_ns - time.monotonic_ns()) * 1e-9)
        got = dict(at_ns)
        print(json.dumps({"numbers": list(got), "at_ns": list(got.values())}), flush=True)
        sys.stdin.readline()


def send(endpoint: str, messages: int, size: int, period_ns: int) -> None:
    """Prints how late the puts began, ms, and whether it has real-time priority; stays until its input ends."""
    behind_ns = []
    with _session("connect", endpoint) as session:
        publisher: Any = session.declare_publisher(_KEY, congestion_control=zenoh.CongestionControl.BLOCK)
        while not publisher.matching_status.matching:
            time.sleep(_NAP_S)
        print("ready", flush=True)
        begin_ns = int(sys.stdin.readline().split()[0])
        for number in range(messages):
            due_ns = begin_ns + number * period_ns
            while (left_ns := due_ns - time.monotonic_ns()) > 0:
                time.sleep(left_ns * 1e-9)
            publisher.put(number.to_bytes(_NUMBER_BYTES, "little").ljust(size, b"."))
            behind_ns.append(-left_ns)
        middle = sorted(behind_ns)[len(behind_ns) // 2]
        real_time = os.sched_getscheduler(0) == os.SCHED_RR
        print(json.dumps({"behind_ms": middle * 1e-6, "real_time": real_time}), flush=True)
        sys.stdin.readline()


def main() -> int:
    options = argparse.ArgumentParser()
    options.add_argument("what", choices=["send", "receive"])
    options.add_argument("endpoint")
    options.add_argument("messages", type=int)
    options.add_argument("--size", type=int, default=64)
    options.add_argument("--period-ns", type=int, default=10_000_000)
    given = options.parse_args()
    urgent()
    if given.what == "receive":
        receive(given.endpoint, given.messages)
    else:
        send(given.endpoint, given.messages, given.size, given.period_ns)
    return 0


if __name__ == "__main__":
    sys.exit(main())
