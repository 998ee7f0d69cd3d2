"""Zenoh sessions: a star around the orchestrator's own session; loopback, no scouting, nothing to install."""

from __future__ import annotations

import json
import os
import re
import socket
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import zenoh

from testbed.errors import UsageError
from testbed.scenario import Tls, Transport
from testbed.wire.bus import BusError

LOOPBACK = "tcp/127.0.0.1:{port}"
_PATIENCE_MS = 60_000
_QUEUE_MAX = 16  # batches of 64 kB on their way out of a process
_SHARED_MIN = 16_384  # bytes of a message from which shared memory pays
_SEGMENT = re.compile(r"/dev/shm/\S+\.zenoh\b")


def open_router(transport: Transport) -> tuple[zenoh.Session, str]:
    """The orchestrator's session and the endpoint it listens on.

    Raises UsageError when the endpoint that the scenario names cannot be opened.
    """
    if transport.endpoint is not None:
        try:
            return _open(transport, "router", listen=transport.endpoint), transport.endpoint
        except zenoh.ZError as error:
            raise UsageError(f"cannot listen on {transport.endpoint}: {_reason(error)}") from None
    scheme = "tls/127.0.0.1:{port}" if transport.tls is not None else LOOPBACK
    for attempt in range(20):
        endpoint = scheme.format(port=_free_port())
        try:
            return _open(transport, "router", listen=endpoint), endpoint
        except zenoh.ZError as error:
            if attempt == 19 or "Address already in use" not in str(error):
                raise UsageError(f"cannot listen on {endpoint}: {_reason(error)}") from None
    raise AssertionError("unreachable")


def open_client(transport: Transport, endpoint: str) -> zenoh.Session:
    """A role's session. Raises BusError when the endpoint cannot be reached."""
    try:
        return _open(transport, "client", connect=endpoint)
    except zenoh.ZError as error:
        raise BusError(f"cannot connect to {endpoint}: {_reason(error)}") from None


def config(transport: Transport, mode: str, *, listen: str | None = None, connect: str | None = None) -> dict[str, Any]:
    """Zenoh configuration as path → value."""
    values: dict[str, Any] = {
        "mode": mode,
        "listen/endpoints": [] if listen is None else [listen],
        "connect/endpoints": [] if connect is None else [connect],
        "connect/timeout_ms": int(transport.deadline_ns / 2e6),
        "connect/exit_on_failure": True,
        "scouting/multicast/enabled": False,
        "scouting/gossip/enabled": False,
        "transport/unicast/accept_timeout": 2_000,
        "transport/unicast/open_timeout": 5_000,
        "transport/link/tx/lease": _PATIENCE_MS,
        "transport/link/tx/queue/congestion_control/block/wait_before_close": _PATIENCE_MS * 1000,
        "transport/link/tx/queue/size/data": _QUEUE_MAX,
        "transport/shared_memory/enabled": bool(transport.shared_memory),
        "transport/shared_memory/transport_optimization/message_size_threshold": _SHARED_MIN,
    }
    if transport.tls is not None:
        values |= _tls(transport.tls, mode)
    if mode == "router" and transport.users_file is not None:
        values["transport/auth/usrpwd/dictionary_file"] = transport.users_file
    if transport.user is not None:
        values["transport/auth/usrpwd/user"] = transport.user
        values["transport/auth/usrpwd/password"] = _password(transport)
    return values


def open_end(
    *,
    listen: str | None = None,
    connect: str | None = None,
    lease_ms: int,
    blocked_ms: int,
    open_ms: int,
    retry_ms: int,
) -> zenoh.Session:
    """One end of a link between two sessions: the one that listens, or the one that connects.

    lease_ms: without a sign of life for so long the connection is given up. blocked_ms: a message that waits so long
    gives it up too. open_ms: for an attempt to connect. retry_ms: between two attempts.
    Raises BusError when the endpoint cannot be had.
    """
    endpoint = listen or connect
    values: dict[str, Any] = {
        "mode": "router" if listen is not None else "client",
        "listen/endpoints": [] if listen is None else [listen],
        "connect/endpoints": [] if connect is None else [connect],
        "connect/timeout_ms": open_ms,
        "connect/exit_on_failure": True,
        "connect/retry": {"period_init_ms": retry_ms, "period_max_ms": retry_ms, "period_increase_factor": 1},
        "scouting/multicast/enabled": False,
        "scouting/gossip/enabled": False,
        "transport/unicast/open_timeout": open_ms,
        "transport/unicast/accept_timeout": open_ms,
        "transport/link/tx/lease": lease_ms,
        "transport/link/tx/queue/congestion_control/block/wait_before_close": blocked_ms * 1000,
        "transport/shared_memory/enabled": False,
    }
    try:
        return _opened(values)
    except zenoh.ZError as error:
        what = "listen on" if listen is not None else "connect to"
        raise BusError(f"cannot {what} {endpoint}: {_reason(error)}") from None


@contextmanager
def closing(session: zenoh.Session) -> Iterator[zenoh.Session]:
    """Close a session at the end, and remove the names of the shared memory it used, which zenoh leaves for later."""
    try:
        yield session
    finally:
        segments = _segments()
        session.close()  # type: ignore[no-untyped-call]
        for segment in segments:
            segment.unlink(missing_ok=True)


def _segments() -> set[Path]:
    """Shared memory of zenoh that this process has mapped."""
    try:
        return {Path(name) for name in _SEGMENT.findall(Path("/proc/self/maps").read_text())}
    except OSError:
        return set()


def _open(transport: Transport, mode: str, *, listen: str | None = None, connect: str | None = None) -> zenoh.Session:
    return _opened(config(transport, mode, listen=listen, connect=connect))


def _opened(values: dict[str, Any]) -> zenoh.Session:
    settings = zenoh.Config()
    for path, value in values.items():
        settings.insert_json5(path, json.dumps(value))
    return zenoh.open(settings)


def _tls(tls: Tls, mode: str) -> dict[str, Any]:
    """Settings of one end; with client certificates both ends prove who they are."""
    mutual = tls.client_certificate is not None
    values: dict[str, Any] = {"root_ca_certificate": tls.ca, "enable_mtls": mutual}
    if mode == "router":
        values |= {"listen_certificate": tls.certificate, "listen_private_key": tls.key}
    elif mutual:
        values |= {"connect_certificate": tls.client_certificate, "connect_private_key": tls.client_key}
    return {f"transport/link/tls/{key}": value for key, value in values.items()}


def _password(transport: Transport) -> str:
    variable = transport.password_env or ""
    password = os.environ.get(variable)
    if password is None:
        raise UsageError(f"transport.password_env: the environment has no variable {variable!r}")
    return password


def _free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


def _reason(error: Exception) -> str:
    """The part of a zenoh error that concerns the user."""
    text = str(error)
    known = re.search(r"\[[^\[\]]*?: ([^\[\]]*?) \(os error \d+\)", text)
    return known.group(1).lower() if known else re.sub(r" at /\S+", "", text).strip(" .")
