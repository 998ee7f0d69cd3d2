"""Whatever ends the owner, nothing stays behind; and what lives is left alone."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass

import pytest

from channel.kernel.ends import alive, hosts, link, users_of, wait_for
from testbed.channel.kernel.ending import clean
from testbed.channel.kernel.marks import leftovers, new_mark, owner_lives

_OWNER = """
import json, os, sys, time
from channel.kernel.ends import hosts, link, network_of
with hosts(link()) as pair:
    shell = pair.a.popen(["sh", "-c", "setsid sleep 1000 & echo $!; wait"], stdout=-1, text=True)
    child = int(shell.stdout.readline())
    networks = [network_of(pair.a), network_of(pair.b)]
    print(json.dumps([pair._engine.pid, shell.pid, child, networks, pair.mark]), flush=True)
    sys.stdin.read()
"""


@dataclass
class Owner:
    process: subprocess.Popen[str]
    engine: int
    shell: int
    child: int
    networks: list[str]
    mark: str

    def gone(self) -> bool:
        return not any(alive(pid) for pid in (self.engine, self.shell, self.child)) and not any(
            users_of(network) for network in self.networks
        )


@contextmanager
def _owner() -> Iterator[Owner]:
    """Another process with hosts, and in one of them a child in a session of its own."""
    environment = {**os.environ, "PYTHONPATH": ":".join(sys.path)}
    pipe = subprocess.PIPE
    command = [sys.executable, "-c", _OWNER]
    with subprocess.Popen(command, stdin=pipe, stdout=pipe, stderr=pipe, text=True, env=environment) as process:
        try:
            assert process.stdout is not None
            yield Owner(process, *json.loads(process.stdout.readline()))
        finally:
            process.kill()


@pytest.mark.root
@pytest.mark.parametrize("number", [signal.SIGKILL, signal.SIGTERM, signal.SIGINT])
def test_an_owner_that_is_killed_takes_everything_with_it(number: signal.Signals) -> None:
    with _owner() as owner:
        assert not owner.gone()
        owner.process.send_signal(number)
        owner.process.wait(30)
        wait_for(owner.gone)


@pytest.mark.root
def test_what_outlives_owner_and_engine_is_removed_at_the_next_start_and_the_living_are_not() -> None:
    with _owner() as dead, _owner() as living:
        os.kill(dead.engine, signal.SIGKILL)
        dead.process.kill()
        dead.process.wait(30)
        assert alive(dead.child)
        wait_for(lambda: dead.child in {one.pid for one in leftovers()})
        with hosts(link()) as pair:
            removed = {one.pid: one for one in pair.removed}
            assert removed[dead.child].hosts == dead.mark
            assert "sleep 1000" in removed[dead.child].command
            assert not alive(dead.shell)
            assert not alive(dead.child)
            assert not {living.engine, living.shell, living.child} & set(removed)
            assert all(alive(pid) for pid in (living.engine, living.shell, living.child))
        assert not [one for one in clean() if one.hosts in (dead.mark, living.mark)]
        assert alive(living.child)


@pytest.mark.root
def test_an_engine_that_is_killed_is_an_error_and_leaves_nothing() -> None:
    with _owner() as owner:
        os.kill(owner.engine, signal.SIGKILL)
        assert owner.process.stdin is not None
        owner.process.stdin.close()
        assert owner.process.wait(30) == 0
        assert owner.gone()


def test_an_owner_is_its_number_and_its_start() -> None:
    mine = new_mark()
    assert owner_lives(mine)
    head, pid, start, rest = mine.split("-")
    assert (head, int(pid)) == ("tb", os.getpid())
    assert not owner_lives(f"{head}-{pid}-{int(start) + 1}-{rest}")
    with subprocess.Popen(["true"]) as short:
        short.wait()
    assert not owner_lives(f"{head}-{short.pid}-{start}-{rest}")
    assert new_mark() != mine


def test_what_is_no_mark_has_no_dead_owner() -> None:
    for text in ("", "tb", "tb-1-x-y", "something-else", "tb-1-2"):
        assert owner_lives(text)


@pytest.mark.root
def test_only_marked_processes_are_ended() -> None:
    """One with the mark of a dead owner, one with another variable, one with the mark of this process."""
    dead = "tb-4194305-1-00000000"  # beyond the greatest process number
    environments = [{"TESTBED_HOSTS": dead}, {"OTHER": dead}, {"TESTBED_HOSTS": new_mark()}]
    sleeps = [subprocess.Popen(["sleep", "1000"], env={**os.environ, **more}) for more in environments]
    try:
        wait_for(lambda: sleeps[0].pid in {one.pid for one in leftovers()})
        ended = {one.pid: one for one in clean()}
        assert ended[sleeps[0].pid].command == "sleep 1000"
        assert sleeps[0].wait(30) == -signal.SIGTERM
        assert [one.poll() for one in sleeps[1:]] == [None, None]
        assert not {one.pid for one in sleeps[1:]} & set(ended)
    finally:
        for one in sleeps:
            one.kill()
            one.wait()
