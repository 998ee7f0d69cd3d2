"""A bare zenoh star that moves messages as a run does and does nothing else: what transport alone allows.

The same processes: the source in router mode, its clients by exec. The same hops in the same order, message sizes,
put settings and window. A relay waits for its trigger and publishes what its role publishes; the number of the step
travels in the first 8 bytes and is asserted. Receiving: ``Callback(SimpleQueue.put, indirect=False)`` and ``q.get()``.
"""

from __future__ import annotations

import argparse
import json
import os
import queue
import socket
import subprocess
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import zenoh

from benchmarks.cpu import Busy, children_of, difference, usage_of
from benchmarks.testbed_run import Result

ROOT = "bare"
_DECLARED: list[Any] = []
"""What zenoh undeclares when it is forgotten."""


@dataclass(frozen=True)
class Relay:
    """A process: it hears ``hears``, and for each message on ``trigger`` publishes ``says``: (key, bytes) in order."""

    name: str
    trigger: str
    says: tuple[tuple[str, int], ...]
    hears: tuple[str, ...] = ()


@dataclass(frozen=True)
class Star:
    """Source → relays → source. The first relay makes single steps of a grant, as the controller does.

    ends: the key that completes a step at the source; hears: the others it must receive. ring: what ends a step begins
    the next one at the first relay, and the source only starts the first and listens.
    """

    grant: tuple[str, int]
    relays: tuple[Relay, ...]
    ends: str
    hears: tuple[str, ...] = ()
    ring: bool = False


def star_of(sizes: dict[str, int], *, whole: bool) -> Star:
    """clock → controller → link.control → plant → link.observation → estimator → orchestrator: six hops.

    sizes: key → bytes of a message. whole: also what lies off the critical path (u to the estimator, the truth to the
    orchestrator).
    """

    def says(*keys: str) -> tuple[tuple[str, int], ...]:
        return tuple((key, sizes[key]) for key in keys)

    return Star(
        ("clock", sizes["clock"]),
        (
            Relay("controller", "clock", says("control/sent")),
            Relay("link.control", "control/sent", says("control/delivered")),
            Relay("plant", "control/delivered", says(*(["truth"] * whole), "observation/sent")),
            Relay("link.observation", "observation/sent", says("observation/delivered")),
            Relay("estimator.aoe", "observation/delivered", says("estimate"), ("control/sent",) * whole),
        ),
        "estimate",
        ("truth",) * whole,
    )


def ring_of(sizes: dict[str, int]) -> Star:
    """controller → link.control → plant → link.observation → estimator → controller: five hops, all between clients."""
    chain = star_of(sizes, whole=False)
    controller = Relay("controller", chain.ends, chain.relays[0].says)
    return Star((chain.ends, sizes[chain.ends]), (controller, *chain.relays[1:]), chain.ends, ring=True)


def message_sizes(n: int, p: int, q: int, lanes: int) -> dict[str, int]:
    """Bytes of each message of a run, as the codec writes them (in the middle of a run; all arrived)."""
    import numpy as np

    from testbed.wire.codec import PacketEncoder, encode
    from testbed.wire.messages import ClockMessage, Control, EstimateMessage, Observation, Truth

    mask = {"mask": np.ones(lanes, np.uint8)}
    u, y, x = np.ones((lanes, q)), np.ones((lanes, p)), np.ones((lanes, n))
    packets = {
        "control/sent": (Control, "controller", {"u": u}),
        "control/delivered": (Control, "link.control", {"u": u, **mask}),
        "observation/sent": (Observation, "plant", {"y": y}),
        "observation/delivered": (Observation, "link.observation", {"y": y, **mask}),
        "truth": (Truth, "plant", {"x": x, "nu": mask["mask"]}),
        "estimate": (EstimateMessage, "estimator.aoe", {"x_hat": x, "P": np.ones((lanes, n, n))}),
    }
    run = "0123456789ab"
    sizes = {
        key: len(PacketEncoder(model, run, source).encode(1000, 1000, 0, lanes, arrays))
        for key, (model, source, arrays) in packets.items()
    }
    return {**sizes, "clock": len(encode(ClockMessage(run=run, source="orchestrator", seq=1000, step=1000)))}


def run_bare(star: Star, *, steps: int, window: int, express: bool, lanes: int = 1) -> Result:
    """Run the star in processes of its own."""
    request = {"star": _as_json(star), "steps": steps, "window": window, "express": express, "lanes": lanes}
    command = [sys.executable, "-m", "benchmarks.bare", "source", json.dumps(request)]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    if done.returncode:
        raise RuntimeError(f"the bare chain failed: {done.stderr[-1500:]}")
    return Result(**json.loads(done.stdout.splitlines()[-1]))


def _as_json(star: Star) -> dict[str, Any]:
    return {
        "grant": star.grant,
        "relays": [vars(relay) for relay in star.relays],
        "ends": star.ends,
        "hears": star.hears,
        "ring": star.ring,
    }


def _open(mode: str, endpoint: str) -> zenoh.Session:
    config = zenoh.Config()
    side = "listen" if mode == "router" else "connect"
    settings = {
        "mode": mode,
        "listen/endpoints": [],
        "connect/endpoints": [],
        f"{side}/endpoints": [endpoint],
        "scouting/multicast/enabled": False,
        "scouting/gossip/enabled": False,
        "transport/link/tx/queue/congestion_control/block/wait_before_close": 60_000_000,
    }
    for path, value in settings.items():
        config.insert_json5(path, json.dumps(value))
    return zenoh.open(config)


def _putter(session: zenoh.Session, key: str, *, express: bool) -> Callable[[bytes], None]:
    publisher = session.declare_publisher(
        f"{ROOT}/{key}",
        congestion_control=zenoh.CongestionControl.BLOCK,
        reliability=zenoh.Reliability.RELIABLE,
        express=express,
    )
    return publisher.put


def _listen(session: zenoh.Session, key: str) -> queue.SimpleQueue[Any]:
    inbox: queue.SimpleQueue[Any] = queue.SimpleQueue()
    _DECLARED.append(session.declare_subscriber(f"{ROOT}/{key}", zenoh.handlers.Callback(inbox.put, indirect=False)))
    return inbox


def _drain(session: zenoh.Session, key: str) -> None:
    """Receive and forget."""
    forget = zenoh.handlers.Callback(lambda _: None, indirect=False)
    _DECLARED.append(session.declare_subscriber(f"{ROOT}/{key}", forget))


def _number(sample: Any) -> int:
    return int.from_bytes(sample.payload.to_bytes()[:8], "little")


def _relay(endpoint: str, relay: Relay, *, express: bool, expand: bool, ahead: bool) -> None:
    """expand: a number stands for all steps up to it; ahead: the step after it is what follows."""
    with _open("client", endpoint) as session:
        for key in relay.hears:
            _drain(session, key)
        inbox, stop = _listen(session, relay.trigger), _listen(session, "stop")
        outlets = [(_putter(session, key, express=express), b"\0" * (size - 8)) for key, size in relay.says]
        _DECLARED.append(session.liveliness().declare_token(f"{ROOT}/ready/{relay.name}"))
        last = 0
        while stop.empty():
            try:
                number = _number(inbox.get(timeout=0.5)) + ahead
            except queue.Empty:
                continue
            assert expand or number == last + 1, f"{relay.name}: {number} after {last}"
            for step in range(last + 1, number + 1):
                head = step.to_bytes(8, "little")
                for put, filler in outlets:
                    put(head + filler)
            last = number


def _source(star: Star, steps: int, window: int, express: bool, lanes: int) -> Result:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        endpoint = f"tcp/127.0.0.1:{probe.getsockname()[1]}"
    with _open("router", endpoint) as session:
        inbox = _listen(session, star.ends)
        for key in star.hears:
            _drain(session, key)
        ready: queue.SimpleQueue[Any] = queue.SimpleQueue()
        arrive = zenoh.handlers.Callback(ready.put, indirect=False)
        _DECLARED.append(session.liveliness().declare_subscriber(f"{ROOT}/ready/*", arrive))
        put = _putter(session, star.grant[0], express=express)
        workers = []
        for i, relay in enumerate(star.relays):
            first = i == 0
            own = {"express": express, "expand": first and not star.ring, "ahead": first and star.ring}
            request = json.dumps({"relay": vars(relay), **own})
            command = [sys.executable, "-m", "benchmarks.bare", "relay", request, "--connect", endpoint]
            workers.append(subprocess.Popen(command))
        try:
            for _ in workers:
                ready.get(timeout=60)
            names = [relay.name for relay in star.relays]
            return _drive(put, star.grant[1], inbox, steps, window, lanes, names, ring=star.ring)
        finally:
            session.put(f"{ROOT}/stop", b"")
            for worker in workers:
                try:
                    worker.wait(10)
                except subprocess.TimeoutExpired:
                    worker.kill()


def _drive(
    put: Callable[[bytes], None],
    size: int,
    inbox: queue.SimpleQueue[Any],
    steps: int,
    window: int,
    lanes: int,
    names: list[str],
    *,
    ring: bool,
) -> Result:
    """Grant as the testbed's clock does: a quarter of the window at a time. A ring is started, and left alone."""
    filler, granted, completed = b"\0" * (size - 8), 0, 0
    processes = {os.getpid(): "source", **dict(zip(children_of(os.getpid()), names, strict=True))}
    before, busy, begun = usage_of(processes), Busy(), time.perf_counter()
    if ring:
        put((0).to_bytes(8, "little") + filler)
        assert _number(inbox.get(timeout=30)) == 0
        granted = steps
    while completed < steps:
        target = min(steps, completed + window)
        if target > granted and (target == steps or target - granted >= max(1, window // 4)):
            granted = target
            put(granted.to_bytes(8, "little") + filler)
        number = _number(inbox.get(timeout=30))
        completed += 1
        assert number == completed, f"source: {number}, expected {completed}"
    wall = time.perf_counter() - begun
    cpu = difference(usage_of(processes), before)
    return Result(steps, lanes, window, wall, cpu, busy.others(sum(sum(parts.values()) for parts in cpu.values())))


def _relay_from(data: dict[str, Any]) -> Relay:
    return Relay(data["name"], data["trigger"], tuple(map(tuple, data["says"])), tuple(data["hears"]))


def main() -> int:
    options = argparse.ArgumentParser()
    options.add_argument("what", choices=["source", "relay"])
    options.add_argument("request", type=json.loads)
    options.add_argument("--connect")
    given = options.parse_args()
    request = given.request
    if given.what == "relay":
        own = {name: request[name] for name in ("express", "expand", "ahead")}
        _relay(given.connect, _relay_from(request["relay"]), **own)
        return 0
    parts = request["star"]
    relays = tuple(map(_relay_from, parts["relays"]))
    star = Star(tuple(parts["grant"]), relays, parts["ends"], tuple(parts["hears"]), parts["ring"])
    print(json.dumps(vars(_source(star, request["steps"], request["window"], request["express"], request["lanes"]))))
    return 0


if __name__ == "__main__":
    sys.exit(main())
