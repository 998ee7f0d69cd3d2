"""A role whose connection is cut while its process goes on: it leaves by itself, and is started again by hand."""

from __future__ import annotations

import shlex
import socket
import subprocess
import threading
from pathlib import Path

import pytest

from processes.running import client, figures_of, finish, free_port, start, summary_of, wait_for_step, write_scenario
from testbed.orchestrator.run import Run
from testbed.scenario import load_scenario

pytestmark = pytest.mark.processes


class Cable:
    """Carries bytes between who connects to ``port`` and another port of this host, until it is cut."""

    def __init__(self, to: int) -> None:
        self._listener = socket.create_server(("127.0.0.1", 0))
        self.port = self._listener.getsockname()[1]
        self._to, self._ends = to, list[socket.socket]()
        threading.Thread(target=self._accept, daemon=True).start()

    def _accept(self) -> None:
        while True:
            try:
                near, _ = self._listener.accept()
                far = socket.create_connection(("127.0.0.1", self._to))
            except OSError:
                return
            self._ends += [near, far]
            for source, sink in ((near, far), (far, near)):
                threading.Thread(target=self._carry, args=(source, sink), daemon=True).start()

    def _carry(self, source: socket.socket, sink: socket.socket) -> None:
        try:
            while content := source.recv(65536):
                sink.sendall(content)
        except OSError:
            pass

    def cut(self) -> None:
        for end in [self._listener, *self._ends]:
            end.close() if end is self._listener else end.shutdown(socket.SHUT_RDWR)


def test_a_role_that_loses_its_connection_leaves_and_may_come_again(tmp_path: Path) -> None:
    port = free_port()
    recovery = '[recovery]\nevery = 100\nroles = { "estimator.aoe" = "restart" }'
    head = f'[transport]\nendpoint = "tcp/127.0.0.1:{port}"\n{recovery}'
    scenario = write_scenario(tmp_path, steps=1_500, head=head)
    process = start(scenario, tmp_path / "out", "--external", "estimator.aoe")
    assert process.stderr is not None

    def by_hand(word: str) -> list[str]:
        while word not in (line := process.stderr.readline()):  # type: ignore[union-attr]
            assert line, "the run ended"
        return shlex.split(line.partition(": ")[2])

    command = by_hand("start estimator.aoe by hand: ")
    cable = Cable(port)
    first = subprocess.Popen([part.replace(f":{port}", f":{cable.port}") for part in command], stderr=subprocess.PIPE)
    with client(port) as session:
        wait_for_step(session, 300)
    cable.cut()
    assert b"the orchestrator is gone" in first.communicate(timeout=30)[1]
    assert first.returncode == 2
    second = subprocess.Popen(by_hand("start estimator.aoe by hand again: "))
    code, _, err = finish(process)
    assert code == 0, err
    assert second.wait(10) == 0
    lost = {(entry["role"], entry["how"]) for entry in summary_of(tmp_path / "out")["recovered"]}
    assert lost == {("estimator.aoe", "is gone")}
    Run(load_scenario(scenario), tmp_path / "plain").in_process()
    assert figures_of(tmp_path / "out") == figures_of(tmp_path / "plain")
