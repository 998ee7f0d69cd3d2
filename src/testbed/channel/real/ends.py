"""One end of a link, a process with a zenoh session of its own; started by the role of the link, never by hand.

``python -m testbed.channel.real.ends --listen ENDPOINT …``: what is published on the key goes to standard output. With
``--connect ENDPOINT`` instead: what comes on standard input is published, each frame at once and on its own. Both say
READY on standard output first, and leave when standard input closes.
"""

from __future__ import annotations

import argparse
import os
import sys
import threading
from collections.abc import Sequence

from testbed.channel.real.frames import framed, messages
from testbed.errors import TestbedError
from testbed.wire.session import closing, open_end
from testbed.wire.zenoh_bus import ZenohBus

READY = b"ready"
_LEAVE_S = 0.5


def main(arguments: Sequence[str] | None = None) -> int:
    given = _options().parse_args(arguments)
    limits = {name: getattr(given, name) for name in ("lease_ms", "blocked_ms", "open_ms", "retry_ms")}
    try:
        session = open_end(listen=given.listen, connect=given.connect, **limits)
    except TestbedError as error:
        print(error, file=sys.stderr)
        return 2
    with closing(session):
        bus = ZenohBus(session, express=True)
        if given.listen is not None:
            _receive(bus, given.key)
        else:
            _send(bus, given.key)
        threading.Thread(target=_leave_soon, daemon=True).start()
    return 0


def _options() -> argparse.ArgumentParser:
    out = argparse.ArgumentParser(description="One end of a link.")
    side = out.add_mutually_exclusive_group(required=True)
    side.add_argument("--listen", metavar="ENDPOINT", help="receive")
    side.add_argument("--connect", metavar="ENDPOINT", help="send")
    out.add_argument("--key", required=True, help="key of the messages")
    for name in ("lease", "blocked", "open", "retry"):
        out.add_argument(f"--{name}-ms", type=int, required=True, help="see testbed.wire.session.open_end")
    return out


def _receive(bus: ZenohBus, key: str) -> None:
    bus.direct = True
    bus.subscribe(key, lambda _, message: _write(framed(message)))
    _write(framed(READY))
    while os.read(0, 4096):
        pass


def _send(bus: ZenohBus, key: str) -> None:
    publish = bus.publisher(key)
    _write(framed(READY))
    for message in messages(sys.stdin.buffer):
        publish(message)


def _write(data: bytes) -> None:
    rest = memoryview(data)
    try:
        while rest:
            rest = rest[os.write(1, rest) :]
    except BrokenPipeError:
        os._exit(3)


def _leave_soon() -> None:
    """Closing a session waits for what cannot be sent any more."""
    threading.Event().wait(_LEAVE_S)
    os._exit(0)


if __name__ == "__main__":
    sys.exit(main())
