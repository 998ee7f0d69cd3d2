"""Network namespaces of this process: made, entered, told apart. Where it lacks the right, within a user namespace."""

from __future__ import annotations

import ctypes
import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from testbed.channel.kernel.enter import setns

_CLONE_NEWNET = 0x40000000
_CLONE_NEWUSER = 0x10000000
_PR_SET_TIMERSLACK = 29
_CAP_NET_ADMIN = 12
_CAP_SYS_ADMIN = 21

_libc = ctypes.CDLL(None, use_errno=True)

Namespace = tuple[int, int]
"""(device, inode) of a namespace: one that somebody holds has these to itself."""


def privileged() -> bool:
    """Whether this process may make network namespaces: CAP_SYS_ADMIN and CAP_NET_ADMIN."""
    for line in Path("/proc/self/status").read_text().splitlines():
        if line.startswith("CapEff:"):
            held = int(line.split()[1], 16)
            return all(held >> capability & 1 for capability in (_CAP_NET_ADMIN, _CAP_SYS_ADMIN))
    return False


def become_root_of_user_namespace() -> int:
    """Move this process, of one thread, into a user namespace of its own as its root; its file descriptor.

    Raises OSError where the kernel or its settings forbid it.
    """
    user, group = os.geteuid(), os.getegid()
    _unshare(_CLONE_NEWUSER)
    Path("/proc/self/setgroups").write_text("deny")
    Path("/proc/self/uid_map").write_text(f"0 {user} 1")
    Path("/proc/self/gid_map").write_text(f"0 {group} 1")
    return os.open("/proc/self/ns/user", os.O_RDONLY | os.O_CLOEXEC)


def new_network() -> int:
    """Move this thread into a new network namespace; its file descriptor. Raises OSError."""
    _unshare(_CLONE_NEWNET)
    return network()


def network() -> int:
    """A file descriptor of this thread's network namespace."""
    return os.open("/proc/thread-self/ns/net", os.O_RDONLY | os.O_CLOEXEC)


@contextmanager
def inside(fd: int) -> Iterator[None]:
    """This thread, for a while, in another network namespace."""
    before = network()
    try:
        setns(fd)
        yield
    finally:
        setns(before)
        os.close(before)


def identity(fd: int) -> Namespace:
    """Of the namespace behind a file descriptor."""
    found = os.fstat(fd)
    return found.st_dev, found.st_ino


def sharp_timers() -> None:
    """No slack for the timers of this thread, where 50 µs are usual."""
    _libc.prctl(_PR_SET_TIMERSLACK, 1, 0, 0, 0)


def _unshare(flags: int) -> None:
    if _libc.unshare(flags):
        raise OSError(ctypes.get_errno(), os.strerror(ctypes.get_errno()))
