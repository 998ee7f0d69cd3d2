"""A run from start to summary: over zenoh with a process a role, or on the in-process bus."""

from __future__ import annotations

import gc
import os
import secrets
import shlex
import shutil
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import replace
from pathlib import Path

import numpy as np

from testbed.channel.real.check import check_links
from testbed.errors import RunFailed, TestbedError, UsageError, did_you_mean
from testbed.orchestrator.conductor import Conductor
from testbed.orchestrator.desk import Desk
from testbed.orchestrator.interrupts import Interrupts, noted
from testbed.orchestrator.journal import Journal
from testbed.orchestrator.keeping import Keeper
from testbed.orchestrator.lanes_file import NAME as LANES
from testbed.orchestrator.lanes_file import LaneFigures, write_lanes
from testbed.orchestrator.outcome import summarise, versions
from testbed.orchestrator.policies import policies_of, silent_roles
from testbed.orchestrator.preflight import check_parts, check_processes, prepare_folder
from testbed.orchestrator.priority import Priorities
from testbed.orchestrator.processes import OneProcess, OwnProcesses
from testbed.orchestrator.recorder import Recorder
from testbed.orchestrator.resuming import FOLDER, Resumed, go_on, resumed, roles_at, services_at
from testbed.orchestrator.roles import RoleSpec, roles_of
from testbed.orchestrator.running import published
from testbed.orchestrator.statistics import Progress
from testbed.orchestrator.summary import Summary, Timing, write_summary
from testbed.orchestrator.supervise import Supervisor, command_of
from testbed.orchestrator.timeline import SNAPSHOTS
from testbed.scenario import EstimatorSpec, Scenario, to_toml
from testbed.scenario.recovery import Policy
from testbed.wire.begin import Begin
from testbed.wire.memory_bus import MemoryBus, MemoryNetwork
from testbed.wire.node import ORCHESTRATOR, Node
from testbed.wire.process import settle_memory
from testbed.wire.setup import Role, Setup

_POLL_S = 0.1
_LEAVE_S = 1.0


def _no_progress(completed: int, steps: int) -> None:
    pass


def _silent(line: str) -> None:
    pass


class Run:
    """One run of a scenario into a folder.

    ``progress`` is called with (completed steps, steps), ``say`` with lines for the user.
    """

    def __init__(
        self,
        scenario: Scenario,
        out: Path,
        *,
        progress: Progress = _no_progress,
        say: Callable[[str], None] = _silent,
        begun: Resumed | None = None,
    ) -> None:
        """begun: what is known of the run, where it goes on; ``scenario`` is then that of ``begun``.

        Raises UsageError where the scenario cannot run or the folder cannot be written, before anything starts.
        """
        check_parts(scenario)
        check_links(scenario)
        prepare_folder(out)
        self._out, self._progress, self._say = out, progress, say
        self._begun = begun
        self._setup = Setup(secrets.token_hex(6) if begun is None else begun.run, scenario)
        self._roles = roles_of(scenario) if begun is None else roles_at(roles_of(scenario), begun)
        self._keeper: Keeper | None = None
        self._begun_s = time.monotonic()
        self._started_s: float | None = None
        self._reported, self._complete = 0, False
        self.desk = Desk()

    @classmethod
    def again(
        cls, out: Path, *, progress: Progress = _no_progress, say: Callable[[str], None] = _silent
    ) -> tuple[Run, Resumed]:
        """The run of a folder that was not finished, and what is known of it. Raises UsageError where there is none."""
        begun = resumed(out)
        return cls(begun.scenario, out, progress=progress, say=say, begun=begun), begun

    def shown_by(self, progress: Progress, say: Callable[[str], None]) -> None:
        """As in the constructor."""
        self._progress, self._say = progress, say

    @property
    def scenario(self) -> Scenario:
        """As it was given."""
        return self._setup.scenario if self._begun is None else self._begun.given

    @np.errstate(all="ignore")  # what is not finite has no figure, and is counted
    def over_zenoh(self, external: Sequence[str] = ()) -> Summary:
        """Across real processes; ``external`` names the roles that somebody starts by hand, again where it goes on.

        Raises UsageError when the endpoint cannot be opened or an external role does not exist.
        """
        from testbed.wire.session import closing, open_router
        from testbed.wire.zenoh_bus import ZenohBus

        names = [role.name for role in self._roles]
        if self._begun is not None:
            external = [role for role in self._begun.external if role in names]
        for name in external:
            if name not in names:
                raise UsageError(
                    f"--external {name}: no such role; allowed: {', '.join(names)}{did_you_mean(name, names)}"
                )
        policies = self._policies(external)
        transport = self._setup.transport
        session, endpoint = open_router(transport)
        supervisor = Supervisor(self._out / "logs")
        recorder = self._recorder()
        with ExitStack() as cleanup:
            interrupts = cleanup.enter_context(noted())
            cleanup.enter_context(closing(session))
            if recorder is not None:
                cleanup.callback(recorder.close)
            journal = cleanup.enter_context(self._journal(external))
            cleanup.callback(supervisor.close, 0.0)
            bus = ZenohBus(session, deadline_s=transport.deadline_ns / 1e9, express=self._setup.express)
            bus.timed = self._setup.real
            self.desk.wake = lambda: bus.call(self.desk.work)
            conductor = self._conductor(bus, recorder, policies, journal, external)
            cleanup.enter_context(published(self._out, self._setup.run, endpoint, transport))

            def launch(role: RoleSpec) -> None:
                if role.name in external:
                    self._say(f"start {role.name} by hand again: {shlex.join(self._by_hand(role, endpoint))}")
                else:
                    supervisor.start(role, endpoint, self._setup.run, transport)

            conductor.services.launch = conductor.recovery.launch = launch
            conductor.services.drop, conductor.ending = supervisor.end, supervisor.ending_of
            conductor.watchdog.stopped = supervisor.stopped
            conductor.timeline.processes = OwnProcesses(supervisor, bus, conductor.restart)
            bus.subscribe(conductor.node.keys.warm("*"), lambda _key, _payload: None)
            importing = threading.Thread(target=_import_report, daemon=True)
            importing.start()
            for role in self._roles:
                if role.name in external:
                    self._say(f"start {role.name} by hand: {shlex.join(self._by_hand(role, endpoint))}")
                else:
                    supervisor.start(role, endpoint, self._setup.run, transport)
            conductor.collector.prepare()
            if self._setup.real:
                importing.join()  # it would take the interpreter from what is due
            with _settled_memory(), self._raised(conductor, lambda: supervisor.pids):
                self._drive(conductor, bus, supervisor, interrupts, patient=bool(external))
            self._settle(conductor, bus)
            supervisor.close(_LEAVE_S if conductor.collector.finished else 0.2)
            return self._finish(conductor, interrupted=interrupts.asked)

    @np.errstate(all="ignore")
    def in_process(self, schedule: int | None = None) -> Summary:
        """On the in-process bus; ``schedule`` seeds the order in which messages to different roles are delivered.

        Raises UsageError where a link needs real time and processes.
        """
        check_processes(self._setup.scenario)
        if self._begun is not None and self._begun.external:
            raise UsageError(
                f"{', '.join(self._begun.external)}: started by hand in this run; allowed: to go on over processes"
            )
        self._setup = replace(self._setup, single=True)
        policies = self._policies() if self._setup.snapshot_every else {}
        network = MemoryNetwork(schedule, timed=self._setup.real)
        recorder = self._recorder()
        with ExitStack() as files:
            if recorder is not None:
                files.callback(recorder.close)
            return self._in_process(network, recorder, policies, files.enter_context(self._journal()))

    def _in_process(
        self, network: MemoryNetwork, recorder: Recorder | None, policies: dict[str, Policy], journal: Journal | None
    ) -> Summary:
        conductor = self._conductor(network.bus(), recorder, policies, journal)
        nodes: list[tuple[Node, Role]] = []

        def join(spec: RoleSpec) -> None:
            drop(spec.name)
            bus = network.bus()
            begin = Begin.from_bytes(bus.ask(conductor.node.keys.begin, spec.name.encode()))
            node = self._setup.join(bus, spec.name, begin)
            nodes.append((node, spec.build(node, self._setup)))
            node.serve(nodes[-1][1])
            node.announce()
            node.catch_up()

        def launch(spec: RoleSpec) -> None:
            try:
                join(spec)
            except TestbedError:
                raise
            except Exception as error:  # as from a process that fails
                raise RunFailed(f"{type(error).__name__}: {error}") from error

        def drop(role: str) -> None:
            for entry in [entry for entry in nodes if entry[0].name == role]:
                nodes.remove(entry)
                entry[0].bus.close()

        conductor.services.launch = conductor.recovery.launch = launch
        conductor.services.drop = drop

        def bus_of(role: str) -> MemoryBus:
            for node, _ in nodes:
                if node.name == role:
                    assert isinstance(node.bus, MemoryBus)
                    return node.bus
            raise UsageError(f"{role}: no role of this run")

        conductor.timeline.processes = OneProcess(bus_of, conductor.restart)
        with ExitStack() as cleanup:
            interrupts = cleanup.enter_context(noted())
            cleanup.enter_context(self._raised(conductor, dict))
            try:
                for spec in self._roles:
                    join(spec)
                while not conductor.over and not interrupts.asked and not conductor.stop_asked:
                    self.desk.work()
                    if not network.step():
                        if conductor.resting:
                            self.desk.wait(_POLL_S)
                        else:
                            conductor.fail(f"nothing moves any more; waiting for {conductor.awaiting()}")
                    self._tell(conductor)
                    if conductor.awaited_words:
                        for node, role in [entry for entry in nodes if entry[0].stopped]:
                            node.report("stopped", role.counters)
                            drop(node.name)
                    if self._keeper is not None:
                        self._keeper.tick()
            except TestbedError as error:
                conductor.fail(str(error))
            conductor.stop()
            _drain(network, lambda: all(node.stopped for node, _ in nodes))
            for node, role in nodes:
                node.report("stopped", role.counters)
            _drain(network, lambda: conductor.all_reported)
            return self._finish(conductor, interrupted=interrupts.asked)

    def _policies(self, external: Sequence[str] = ()) -> dict[str, Policy]:
        return policies_of(self._setup.scenario, self._roles, external, self._services)

    @property
    def _services(self) -> dict[str, EstimatorSpec]:
        """The estimators of roles that the scenario has not, where the run goes on."""
        return {} if self._begun is None else services_at(self._begun)

    def _conductor(
        self,
        bus: object,
        recorder: Recorder | None,
        policies: dict[str, Policy],
        journal: Journal | None,
        external: Sequence[str] = (),
    ) -> Conductor:
        begin = 0 if self._begun is None else self._begun.step
        conductor = Conductor(bus, self._setup, self._roles, recorder, policies, begin)  # type: ignore[arg-type]
        conductor.on_started, conductor.say = self._mark_start, self._say
        if journal is not None:
            silent = silent_roles(self._setup.scenario, self._roles, policies, external, self._services)
            conductor.recovery.silent.update(silent)
        if self._begun is not None:
            go_on(conductor, self._begun)
        if journal is not None:
            self._keeper = Keeper(journal, conductor, recorder, len(self.scenario.events))
        conductor.timeline.folder = self._out / SNAPSHOTS
        self.desk.open(conductor)
        return conductor

    def _mark_start(self) -> None:
        self._started_s = time.monotonic()

    @contextmanager
    def _raised(self, conductor: Conductor, pids: Callable[[], dict[str, int]]) -> Iterator[None]:
        """From the start of the run on, the real-time priority that the scenario asks for; it ends with the block."""
        priority, pacing = self._setup.scenario.clock.priority, conductor.pacing
        if priority is None or pacing is None:
            yield
            return
        priorities = Priorities(priority)
        pacing.priorities = priorities.raised

        def start() -> None:
            self._mark_start()
            priorities.raise_all({ORCHESTRATOR: os.getpid(), **pids()})

        def rise(role: str) -> None:
            priorities.raise_all({name: pid for name, pid in pids().items() if name == role})

        conductor.on_started, conductor.on_present = start, rise
        try:
            yield
        finally:
            priorities.lower_own()

    def _recorder(self) -> Recorder | None:
        scenario, path = self._setup.scenario, self._out / "recording.mcap"
        if scenario.record == "none":
            path.unlink(missing_ok=True)
            return None
        metadata = {"name": scenario.name, "scenario": to_toml(self.scenario)}
        done = None if self._begun is None or not self._begun.step else self._begun.step
        return Recorder(
            path, lanes=self._setup.tap, period_ns=scenario.clock.period_ns, metadata=metadata, resumed=done
        )

    @contextmanager
    def _journal(self, external: Sequence[str] = ()) -> Iterator[Journal | None]:
        """What lets the run be finished should this process die; it is removed when the run is complete."""
        wanted, folder = self._setup.scenario.recovery.journal, self._out / FOLDER
        if wanted is False or (wanted is None and self._setup.single) or self._setup.real:
            shutil.rmtree(folder, ignore_errors=True)
            yield None
            return
        journal = Journal(folder)
        if self._begun is None:
            journal.begin(
                {
                    "run": self._setup.run,
                    "scenario": to_toml(self.scenario),
                    "external": list(external),
                    "versions": versions(),
                }
            )
        else:
            journal.go_on(self._begun.step)
            journal.note(resumed=self._begun.record.model_dump(mode="json"))
        try:
            yield journal
        finally:
            with suppress(RunFailed):  # told before, or of no consequence any more
                journal.close()
            if self._complete:
                shutil.rmtree(folder, ignore_errors=True)

    def _by_hand(self, role: RoleSpec, endpoint: str) -> list[str]:
        return command_of(role, endpoint, self._setup.run, self._setup.transport)

    def _drive(
        self, conductor: Conductor, bus: object, supervisor: Supervisor, interrupts: Interrupts, *, patient: bool
    ) -> None:
        """Until the run is over, has failed, or made no progress for the deadline."""
        deadline_s = self._setup.scenario.transport.deadline_ns / 1e9
        last, since, looked = -1, time.monotonic(), 0.0
        while not conductor.over and not interrupts.asked and not conductor.stop_asked:
            bus.run(_POLL_S)  # type: ignore[attr-defined]
            now = time.monotonic()
            if now - looked < _POLL_S:
                continue
            looked = now
            self.desk.work()
            self._tell(conductor)
            for role, ending in supervisor.dead().items():
                conductor.ended(role, f"{ending}{_last_words(supervisor.log_of(role))}")
            conductor.tick(deadline_s)
            self._keep(conductor)
            if conductor.activity != last:
                last, since = conductor.activity, now
            elif now - since > deadline_s and not (patient and (not conductor.started or conductor.recovery.down)):
                conductor.fail(f"no progress for {deadline_s:g} s; waiting for {conductor.awaiting()}")
        self._tell(conductor)
        if conductor.failure is not None and conductor.failure.endswith(" is gone"):
            role = conductor.failure.removesuffix(" is gone")
            if (how := supervisor.ending_of(role)) is not None:
                conductor.failure = f"{role} ended: {how}{_last_words(supervisor.log_of(role))}"

    def _keep(self, conductor: Conductor) -> None:
        if self._keeper is not None:
            try:
                self._keeper.tick()
            except RunFailed as error:
                conductor.fail(str(error))

    def _settle(self, conductor: Conductor, bus: object) -> None:
        """Stop the roles and hear their last words."""
        conductor.stop()
        if conductor.failure is not None:
            self._say(f"stopping: {conductor.failure}")
        deadline = time.monotonic() + (5.0 if conductor.collector.finished else 0.4)
        while not conductor.all_reported and time.monotonic() < deadline:
            bus.run(0.02)  # type: ignore[attr-defined]

    def _tell(self, conductor: Conductor) -> None:
        completed = conductor.collector.completed
        if completed != self._reported:
            self._reported = completed
            self._progress(completed, self._setup.scenario.steps)

    def _finish(self, conductor: Conductor, *, interrupted: bool) -> Summary:
        now = time.monotonic()
        begun = self._started_s if self._started_s is not None else now
        wall = now - begun
        lanes = self._setup.scenario.lanes
        done = conductor.collector.completed - (0 if self._begun is None else self._begun.step)
        timing = Timing(
            wall_s=wall,
            startup_s=begun - self._begun_s,
            steps_per_s=done / wall if wall > 0 else None,
            lane_steps_per_s=done * lanes / wall if wall > 0 else None,
            window=self._setup.window,
            swaps=conductor.services.swaps(),
        )
        conductor.timeline.give_up()
        if conductor.stop_asked and not conductor.collector.finished:
            status = "interrupted"
            reason: str | None = conductor.stop_asked
        elif interrupted and not conductor.collector.finished:
            status, reason = "interrupted", "interrupted by the user"
        elif conductor.failure is not None:
            status, reason = "failed", conductor.failure
        else:
            status, reason = "complete", None
        summary = summarise(conductor, status=status, reason=reason, timing=timing)
        write_results(self._out, summary, self.scenario, conductor.collector.by_lane())
        self._complete = status == "complete"
        return summary


def _drain(network: MemoryNetwork, until: Callable[[], bool]) -> None:
    """Deliver what is left; a role that has failed may fail again at each message that still waits for it."""
    while not until():
        try:
            if not network.step():
                return
        except TestbedError:
            continue


def write_results(out: Path, summary: Summary, scenario: Scenario, lanes: LaneFigures) -> None:
    """scenario.toml, summary.json, lanes.npz and report.html. Raises RunFailed where the disk refuses."""
    from testbed.orchestrator.report import write_report

    toml = to_toml(scenario)
    try:
        (out / "scenario.toml").write_text(toml)
        write_summary(out / "summary.json", summary)
        write_lanes(out / LANES, lanes)
        write_report(out / "report.html", summary, toml)
    except OSError as error:
        raise RunFailed(f"cannot write the results into {out}: {error.strerror}") from None


@contextmanager
def _settled_memory() -> Iterator[None]:
    """As in the roles, and as it was afterwards."""
    before = gc.get_threshold()
    settle_memory()
    try:
        yield
    finally:
        gc.set_threshold(*before)
        gc.unfreeze()


def _import_report() -> None:
    """Load what draws the report while the roles start, so that a run that fails can end at once."""
    import testbed.orchestrator.report  # noqa: F401


def _last_words(log: Path) -> str:
    """The last line of a role's log, for an error text."""
    try:
        lines = log.read_text(errors="replace").strip().splitlines()
    except OSError:
        return ""
    return f" ({lines[-1][:200]})" if lines else ""
