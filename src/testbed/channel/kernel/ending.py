"""End processes: those inside namespaces that are being given up, and those that dead owners left."""

from __future__ import annotations

import os
import select
import signal
import time
from collections.abc import Callable, Collection, Iterable

from testbed.channel.kernel.marks import Leftover, command_of, is_left, leftovers, pids
from testbed.channel.kernel.namespaces import Namespace

_PATIENCE_S = 1.0
_DEADLINE_S = 5.0


def end_within(namespaces: Collection[Namespace], mark: str) -> list[str]:
    """End every other process in these network namespaces, or on its way there with the mark.

    Returns the command lines of those that needed SIGKILL.
    """
    stubborn: list[str] = []
    deadline = time.monotonic() + _DEADLINE_S
    while True:  # again: one may have started another meanwhile
        checks = {pid: _within(pid, namespaces, mark) for pid in pids()}
        found = {pid: check for pid, check in checks.items() if check()}
        if not found or time.monotonic() > deadline:
            return stubborn
        stubborn += _end(found)


def clean() -> list[Leftover]:
    """End the processes that dead owners left, and with the last in a namespace the namespace; what was found."""
    left = leftovers()
    _end({one.pid: _still(one) for one in left})
    return left


def _within(pid: int, namespaces: Collection[Namespace], mark: str) -> Callable[[], bool]:
    def check() -> bool:
        try:
            found = os.stat(f"/proc/{pid}/ns/net")
        except OSError:
            return False
        return (found.st_dev, found.st_ino) in namespaces or is_left(pid, mark)

    return check


def _still(one: Leftover) -> Callable[[], bool]:
    return lambda: is_left(one.pid, one.hosts)


def _end(processes: dict[int, Callable[[], bool]]) -> list[str]:
    """SIGTERM, and SIGKILL for those that are still there after a while. Each is checked when nobody else can get its
    number any more."""
    handles = {}
    for pid, check in processes.items():
        try:
            handle = os.pidfd_open(pid)
        except OSError:
            continue
        if check():
            handles[handle] = pid
        else:
            os.close(handle)
    _signal(handles, signal.SIGTERM)
    stubborn = _wait(handles, _PATIENCE_S)
    commands = [command_of(handles[handle]) for handle in stubborn]
    _signal(stubborn, signal.SIGKILL)
    _wait(stubborn, _PATIENCE_S)
    for handle in handles:
        os.close(handle)
    return commands


def _signal(handles: Iterable[int], number: signal.Signals) -> None:
    for handle in handles:
        try:
            signal.pidfd_send_signal(handle, number)
        except OSError:  # gone, or not ours to end
            continue


def _wait(handles: Collection[int], seconds: float) -> list[int]:
    """Those that are still there."""
    poll = select.poll()
    left = set(handles)
    for handle in left:
        poll.register(handle, select.POLLIN)
    deadline = time.monotonic() + seconds
    while left and (remaining := deadline - time.monotonic()) > 0:
        for handle, _ in poll.poll(remaining * 1000):
            poll.unregister(handle)
            left.discard(handle)
    return sorted(left)
