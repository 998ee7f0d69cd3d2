"""Become a command inside namespaces: ``python enter.py FDS COMMAND…``, FDS as "3,4", those of a user namespace first.

A script on its own, without the rest of the package, so that it starts quickly.
"""

from __future__ import annotations

import ctypes
import os
import sys

_libc = ctypes.CDLL(None, use_errno=True)


def setns(fd: int) -> None:
    """Move this thread into the namespace of a file descriptor. Raises OSError."""
    if _libc.setns(fd, 0):
        raise OSError(ctypes.get_errno(), os.strerror(ctypes.get_errno()))


def main(fds: str, *command: str) -> None:
    """Never returns: the process becomes the command, or ends with code 127."""
    for fd in fds.split(","):
        setns(int(fd))
        os.close(int(fd))
    try:
        os.execvp(command[0], command)
    except OSError as error:
        print(f"{command[0]}: {error.strerror}", file=sys.stderr)
        sys.exit(127)


if __name__ == "__main__":
    main(*sys.argv[1:])
