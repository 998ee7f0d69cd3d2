"""The process between the hosts: makes their namespaces, runs the link, ends what runs in them when it is over.

It is over when the owner says so, and when the owner is gone, however it went: its end is seen through a pidfd.

``python -m testbed.channel.kernel.engine FD OWNER``: the socket to the owner, whose process number OWNER is.
"""

from __future__ import annotations

import gc
import os
import signal
import socket
import sys
from contextlib import suppress

from testbed.channel.kernel.control import Control
from testbed.channel.kernel.ending import end_within
from testbed.channel.kernel.marks import VARIABLE
from testbed.channel.kernel.namespaces import (
    Namespace,
    become_root_of_user_namespace,
    identity,
    privileged,
    sharp_timers,
)
from testbed.channel.kernel.plan import Hosts, Plan, Refused
from testbed.errors import TestbedError


def main(fd: int, owner: int) -> int:
    control = Control(socket.socket(fileno=fd))
    alive = os.pidfd_open(owner)
    if os.getppid() != owner:
        return 1
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(143))
    plan, _ = control.receive()
    namespaces: set[Namespace] = set()
    try:
        hosts, fds = _make(plan)
        namespaces = {identity(network) for network in hosts.networks}
        control.send({"made": True}, fds)
        hosts.prepare(plan)
        control.send({"ready": True})
    except Refused as refused:
        control.send({"refused": str(refused)})
        return 1
    except TestbedError as error:
        control.send({"wrong": str(error)})
        return 1
    sharp_timers()
    with suppress(OSError):  # without root rights, like any other process
        os.sched_setscheduler(0, os.SCHED_RR, os.sched_param(1))
    gc.freeze()
    gc.disable()
    try:
        hosts.serve({control.fileno(): lambda: _answer(control, hosts), alive: lambda: False})
    finally:
        stubborn = end_within(namespaces, os.environ.get(VARIABLE, ""))
        hosts.end()
    try:
        control.send({"books": hosts.books(), "stubborn": stubborn})
    except OSError:  # the owner is gone
        return 1
    return 0


def _make(plan: Plan) -> tuple[Hosts, list[int]]:
    """The hosts, and the file descriptors for the owner: (user namespace,) network of a, network of b."""
    user = []
    if not privileged():
        try:
            user = [become_root_of_user_namespace()]
        except OSError as error:
            raise Refused(f"user namespaces: {error.strerror}") from None
    if plan["backend"] == "netem":
        from testbed.channel.kernel.netem_hosts import NetemHosts

        hosts: Hosts = NetemHosts(plan)
    else:
        from testbed.channel.kernel.tun_hosts import TunHosts

        hosts = TunHosts(plan)
    return hosts, [*user, *hosts.networks]


def _answer(control: Control, hosts: Hosts) -> bool:
    """One request of the owner; False if it was the last."""
    try:
        asked, _ = control.receive()
    except EOFError:
        return False
    if "end" in asked:
        return False
    try:
        if "change" in asked:
            hosts.change(asked["change"], asked["impairments"])
        if "begin" in asked:
            hosts.begin(asked["begin"])
        answer: dict[str, object] = {"books": hosts.books()}
    except TestbedError as error:
        answer = {"wrong": str(error)}
    try:
        control.send(answer)
    except OSError:
        return False
    return True


if __name__ == "__main__":
    sys.exit(main(int(sys.argv[1]), int(sys.argv[2])))
