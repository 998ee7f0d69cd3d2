"""A run that goes, seen from outside: where it listens, and how to ask something of it."""

from __future__ import annotations

import json
import os
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from testbed.errors import UsageError
from testbed.orchestrator.summary import Happened, read_summary
from testbed.scenario import Transport

NAME = "run.json"
_POLL_S = 0.05


@contextmanager
def published(out: Path, run: str, endpoint: str, transport: Transport) -> Iterator[None]:
    """While the run goes, its folder says where: run.json. It holds no password, and only its user may read it."""
    path = out / NAME
    told = {"run": run, "endpoint": endpoint, "pid": os.getpid(), "transport": transport.model_dump(mode="json")}
    path.unlink(missing_ok=True)
    with os.fdopen(os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600), "w") as file:
        json.dump(told, file)
    try:
        yield
    finally:
        path.unlink(missing_ok=True)


Ask = Callable[[dict[str, Any]], dict[str, Any]]


def ask(out: Path, question: dict[str, Any], patience_s: float = 10.0) -> dict[str, Any]:
    """The answer of the run in a folder. Raises UsageError where none goes there, or where it refuses."""
    with asking(out, patience_s) as put:
        return put(question)


@contextmanager
def asking(out: Path, patience_s: float = 10.0) -> Iterator[Ask]:
    """A function that asks the run in a folder. It raises UsageError where the run refuses or is not there any more."""
    from testbed.wire.bus import BusError
    from testbed.wire.keys import Keys
    from testbed.wire.session import closing, open_client
    from testbed.wire.zenoh_bus import ZenohBus

    try:
        told = json.loads((out / NAME).read_text())
        run, endpoint = str(told["run"]), str(told["endpoint"])
        transport = Transport.model_validate(told["transport"])
        alive = Path(f"/proc/{int(told['pid'])}").exists() or not Path("/proc/self").exists()
    except OSError:
        raise UsageError(f"{out}: no run goes there; allowed: the folder of a run that goes, over zenoh") from None
    except (ValueError, KeyError, TypeError):
        raise UsageError(f"{out / NAME}: not written by a run") from None
    if not alive:
        raise UsageError(f"{out}: its run ended without a word; allowed: the folder of a run that goes")

    def put(question: dict[str, Any]) -> dict[str, Any]:
        try:
            answer: dict[str, Any] = json.loads(bus.ask(Keys(run).ask, json.dumps(question).encode()))
        except BusError as error:
            raise UsageError(f"{out}: its run gave no answer: {error}") from None
        if "error" in answer:
            raise UsageError(str(answer["error"]))
        return answer

    try:
        session = open_client(transport, endpoint)
    except BusError as error:
        raise UsageError(f"{out}: its run gave no answer: {error}") from None
    with closing(session):
        bus = ZenohBus(session, deadline_s=patience_s)
        yield put


def outcome_of(out: Path, put: Ask, number: int) -> list[Happened]:
    """What became of an event that was asked for; waits for it. That of ACKs may be several changes.

    Raises UsageError where the run ends without a word of it.
    """
    while True:
        try:
            status = put({"do": "status"})
            found = [Happened.model_validate(event) for event in status["events"]]
        except UsageError:
            if (out / NAME).exists():
                raise
            found = list(read_summary(out / "summary.json").events)
            status = {"pending": []}
        if number not in status["pending"]:
            if events := [event for event in found if event.number == number]:
                return events
            raise UsageError(f"{out}: its run ended before")
        time.sleep(_POLL_S)
