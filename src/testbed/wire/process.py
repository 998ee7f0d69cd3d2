"""A role as a process of its own: join the run, serve, report, leave."""

from __future__ import annotations

import argparse
import gc
import json
import os
import sys
import threading
import traceback
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path

import numpy as np
from pydantic import ValidationError

from testbed.errors import TestbedError
from testbed.scenario import Transport
from testbed.wire.begin import Begin
from testbed.wire.bus import BusError
from testbed.wire.keys import Keys
from testbed.wire.node import ORCHESTRATOR, Node
from testbed.wire.session import closing, open_client
from testbed.wire.setup import Build, Role, Setup
from testbed.wire.zenoh_bus import ZenohBus

_POLL_S = 1.0
_WARM = 1 << 20  # bytes of a message that goes through shared memory, which is made at the first of them


def parser(description: str) -> argparse.ArgumentParser:
    """The options that every role's process has."""
    out = argparse.ArgumentParser(description=description)
    out.add_argument(
        "--connect", required=True, metavar="ENDPOINT", help="where the run listens, e.g. tcp/127.0.0.1:7447"
    )
    out.add_argument("--run", required=True, metavar="RUN", help="identity of the run, as `testbed run` prints it")
    out.add_argument("--transport", default="{}", metavar="JSON", help="[transport] of the scenario, where it has one")
    out.add_argument("--supervised", action="store_true", help="leave when standard input closes")
    return out


def serve(options: argparse.Namespace, name: str, build: Build) -> int:
    """Run one role until the orchestrator stops it or goes away. Returns the exit code."""
    if options.supervised:
        threading.Thread(target=_leave_with_parent, daemon=True).start()
    try:
        transport = Transport.model_validate(json.loads(options.transport))
    except (ValidationError, ValueError) as error:
        return _refuse(f"--transport: {error}")
    try:
        session = open_client(transport, options.connect)
    except TestbedError as error:
        return _refuse(str(error))
    with closing(session):
        return _serve(ZenohBus(session, deadline_s=transport.deadline_ns / 1e9), options.run, name, build)


def _serve(bus: ZenohBus, run: str, name: str, build: Build) -> int:
    orphaned, keys = threading.Event(), Keys(run)
    try:
        setup = Setup.from_json(bus.ask(keys.scenario))
        begin = Begin.from_bytes(bus.ask(keys.begin, name.encode()))
    except BusError as error:
        return _refuse(str(error))
    bus.express, bus.timed = setup.express, setup.real
    if setup.real:
        wake_on_time()
    node = setup.join(bus, name, begin)
    bus.direct = setup.direct
    with node.leaving:
        return _play(bus, node, setup, build, orphaned)


def _play(bus: ZenohBus, node: Node, setup: Setup, build: Build, orphaned: threading.Event) -> int:
    role: Role | None = None
    name = node.name
    try:
        role = build(node, setup)
        node.serve(role)
        bus.watch(node.keys.presence(ORCHESTRATOR), lambda _, alive: None if alive else orphaned.set())
        if setup.transport.shared_memory:
            bus.publisher(node.keys.warm(name))(bytes(_WARM))
        settle_memory()
        node.announce()
        node.catch_up()
        with np.errstate(all="ignore"):  # what is not finite is looked for where it would leave a role
            while not node.stopped and not orphaned.is_set():
                bus.run(_POLL_S)
    except Exception as error:
        text = str(error) if isinstance(error, TestbedError) else f"{type(error).__name__}: {error}"
        traceback.print_exc()
        node.report("failed", {} if role is None else role.counters, text)
        return 1
    if orphaned.is_set():
        return _refuse(f"{name}: the orchestrator is gone")
    node.report("stopped", role.counters)
    return 0


def wake_on_time() -> None:
    """Let the system wake this thread when its time has come, not up to 50 µs later to save energy."""
    with suppress(OSError):
        Path("/proc/self/timerslack_ns").write_text("1")


def settle_memory() -> None:
    """What is there now stays: keep the garbage collector from looking at it again and again while packets flow."""
    gc.collect()
    gc.freeze()
    gc.set_threshold(50_000, 20, 50)


def _refuse(text: str) -> int:
    print(text, file=sys.stderr)
    return 2


def _leave_with_parent() -> None:
    """End this process when the supervisor's end of our standard input closes, however it died."""
    while os.read(0, 4096):
        pass
    os._exit(3)


def main(arguments: Sequence[str] | None, name: str, build: Build, description: str) -> int:
    """The whole of a role's ``__main__`` that has no options of its own."""
    return serve(parser(description).parse_args(arguments), name, build)
