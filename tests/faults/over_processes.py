"""One seed over real processes: roles are killed or stopped at random times, and the figures stay what they were."""

from __future__ import annotations

import os
import random
import signal
import threading
import time
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

from faults.observed import Observed, files_of
from faults.scenarios import scenario_table
from faults.timeline import events
from faults.trial import Table, Trial
from faults.verdict import Outcome, findings
from orchestrator.runs import run
from processes.running import children_of
from testbed.orchestrator.run import Run
from testbed.orchestrator.summary import Summary
from testbed.scenario import parse_scenario

STEPS = 600
_WATCHED = ("testbed.plant", "testbed.channel", "testbed.control", "testbed.estimator")


@dataclass(frozen=True)
class Signal:
    """Sent to a role once the run is past a share of its steps. cont_s: when it goes on; None: not by itself."""

    past: float
    which: float
    number: signal.Signals
    cont_s: float | None = None


def trial(seed: int, folder: Path) -> Trial:
    """In one process without faults, and over processes with them: the same to the bit."""
    draw = random.Random(seed)
    table = scenario_table(draw)
    table |= {"steps": STEPS, "record": draw.choice(("first", "none"))}
    table["estimators"] = [spec for spec in table["estimators"] if spec["kind"] != "oe"] or [
        {"name": "a", "kind": "gpb1", "acks": "none"}
    ]
    if table["input"].get("estimator", "a") not in [s["name"] for s in table["estimators"] if "until" not in s]:
        table["input"] = {"kind": "sine", "amplitude": 2.0, "period": 7.0}
    table["events"] = events(draw, table)
    recovery: Table = {"every": draw.choice((20, 50, 200)), "restarts": 20, "patience": "2 s"}
    made = Trial(seed, table, recovery, schedule=None)
    made.faults = signals(draw)
    observed = Observed()
    with observed.watching():
        plain = run(parse_scenario(table), folder / "plain")
    made.plain = Outcome(plain, Observed(), files_of(folder / "plain"), 0, [], [])
    summary, log, killed = _disturbed({**table, "recovery": recovery}, folder / "disturbed", made.faults)
    made.disturbed = Outcome(summary, Observed(), files_of(folder / "disturbed"), 0, killed, log)
    made.problems = findings(made.plain, made.disturbed, recovery)
    return made


def signals(draw: random.Random) -> list[Signal]:
    out = []
    for _ in range(draw.choice((1, 2, 3))):
        past = draw.uniform(0.02, 0.9)
        number, cont_s = draw.choice(
            ((signal.SIGKILL, None), (signal.SIGKILL, None), (signal.SIGSTOP, None), (signal.SIGSTOP, 0.4))
        )
        out.append(Signal(round(past, 3), round(draw.random(), 3), number, cont_s))
    return sorted(out, key=lambda one: one.past)


def _disturbed(table: Table, folder: Path, coming: list[Signal]) -> tuple[Summary, list[str], list[str]]:
    completed, over = 0, threading.Event()
    log: list[str] = []
    killed: list[str] = []

    def progress(done: int, _: int) -> None:
        nonlocal completed
        completed = done

    def send() -> None:
        for one in coming:
            while completed < one.past * STEPS:
                if over.wait(0.001):
                    return
            roles = sorted((command, pid) for pid, command in children_of(os.getpid()).items() if _is_role(command))
            if not roles:
                continue
            command, pid = roles[int(one.which * len(roles))]
            log.append(f"past step {completed}: {one.number.name} to {_role(command)}")
            if one.cont_s is None:
                killed.append(_role(command))
            with suppress(ProcessLookupError):
                os.kill(pid, one.number)
                if one.cont_s is not None:
                    time.sleep(one.cont_s)
                    os.kill(pid, signal.SIGCONT)

    sender = threading.Thread(target=send, daemon=True)
    sender.start()
    try:
        summary = Run(parse_scenario(table), folder, progress=progress).over_zenoh()
    finally:
        over.set()
        sender.join()
    return summary, log, killed


def _is_role(command: str) -> bool:
    return any(f"-m {module}" in command for module in _WATCHED)


def _role(command: str) -> str:
    """Of a role's process."""
    words = command.split()
    module = words[words.index("-m") + 1].removeprefix("testbed.")
    for option, kind in (("--role", ""), ("--name", "estimator."), ("--link", "link.")):
        if option in words:
            return kind + words[words.index(option) + 1]
    return {"control": "controller", "estimator.bounds_service": "bounds"}.get(module, module)
