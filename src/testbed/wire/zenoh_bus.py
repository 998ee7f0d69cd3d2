"""The bus over Eclipse Zenoh, between processes."""

from __future__ import annotations

import ctypes
import queue
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import zenoh

from testbed.wire.bundle import bundle
from testbed.wire.bus import Answer, BusError, Handler, PresenceHandler, Publish

INBOX_MAX = 65536
"""Messages waiting in a process beyond which its receiving thread pauses, and zenoh holds back the senders."""


_AT_ONCE = 256  # events handled before what they gave rise to is sent
_BUNDLE_MAX = 64  # messages
_HELD_MAX_S = 0.05  # lazy messages are sent after so long at the latest, where there are others to handle
_IDLE_S = 0.02  # without work for so long, lazy messages are sent
_SMALL = 16_384  # bytes; a larger message does not wait


@dataclass
class _Outgoing:
    """What waits to be sent on one key."""

    put: Publish
    waiting: list[bytes]
    lazy: bool
    since: float = 0.0


class ZenohBus:
    """Publishes reliably and blocking; hands every event to the thread that calls ``run``.

    Small messages that come out of events handled in one go leave in one payload for each key, so that order is kept
    on each key but not between keys.

    express: send each message at once instead of batching; right when only one is in flight. direct: handle messages
    on the thread that receives them, while ``run`` waits for everything else; right for small messages of which one is
    in flight, in a client, whose messages all come over one link. Both count for what is declared afterwards.
    """

    def __init__(self, session: zenoh.Session, *, deadline_s: float = 10.0, express: bool = False) -> None:
        self._session, self._deadline_s, self.express = session, deadline_s, express
        self.direct = False
        self._lock = threading.Lock()
        self._failed = False
        self._inbox: queue.SimpleQueue[tuple[Callable[..., None], Any]] = queue.SimpleQueue()
        self._declared: list[Any] = []
        self._outbox: list[_Outgoing] = []
        self._handling = False

    def run(self, timeout_s: float) -> bool:
        """Handle what has arrived, waiting up to ``timeout_s`` for the first; False if nothing came."""
        try:
            handle, event = self._inbox.get(timeout=self._patience_s(timeout_s))
        except queue.Empty:
            self.flush()
            return False
        with self._lock:
            self._handling = True
            try:
                handle(event)
                for _ in range(min(self._inbox.qsize(), _AT_ONCE)):
                    handle, event = self._inbox.get_nowait()
                    handle(event)
            finally:
                self._handling = False
                self._send(lazy=False)
        return True

    def flush(self) -> None:
        """Send everything that is held back."""
        with self._lock:
            self._send(lazy=True)

    def publisher(self, key: str, *, lazy: bool = False) -> Publish:
        publisher = self._session.declare_publisher(
            key,
            congestion_control=zenoh.CongestionControl.BLOCK,
            reliability=zenoh.Reliability.RELIABLE,
            express=self.express,
        )
        self._declared.append(publisher)
        put: Publish = publisher.put
        waiting: list[bytes] = []
        self._outbox.append(_Outgoing(put, waiting, lazy))

        def publish(payload: bytes) -> None:
            if not self._handling and not (lazy and self.direct):
                put(payload)
                return
            waiting.append(payload)
            if len(waiting) >= _BUNDLE_MAX or len(payload) > _SMALL:
                put(bundle(waiting))
                waiting.clear()

        return publish

    def subscribe(self, key: str, handler: Handler) -> None:
        def handle(sample: Any) -> None:
            handler(str(sample.key_expr) if "*" in key else key, sample.payload.to_bytes())

        receive = self._at_once(handle) if self.direct else self._into_inbox(handle)
        self._declared.append(self._session.declare_subscriber(key, receive))

    def ask(self, key: str, question: bytes = b"") -> bytes:
        replies = self._session.get(key, payload=question, timeout=self._deadline_s)
        for reply in replies:
            if reply.ok is not None:
                return bytes(reply.ok.payload.to_bytes())
            raise BusError(f"{key}: {reply.err.payload.to_string() if reply.err else 'no answer'}")
        raise BusError(f"no answer on {key} within {self._deadline_s:g} s")

    def answer(self, key: str, answer: Answer) -> None:
        def reply(query: Any) -> None:
            with query:
                query.reply(key, answer(query.payload.to_bytes() if query.payload is not None else b""))

        self._declared.append(self._session.declare_queryable(key, self._into_inbox(reply)))

    def announce(self, key: str) -> None:
        self._declared.append(self._session.liveliness().declare_token(key))

    def watch(self, key: str, handler: PresenceHandler) -> None:
        def handle(sample: Any) -> None:
            handler(str(sample.key_expr), sample.kind == zenoh.SampleKind.PUT)

        liveliness = self._session.liveliness()
        self._declared.append(liveliness.declare_subscriber(key, self._into_inbox(handle), history=True))

    def call(self, order: Callable[[], None]) -> None:
        self._inbox.put((_obey, order))

    def close(self) -> None:
        self.flush()
        self._session.close()  # type: ignore[no-untyped-call]

    def _send(self, *, lazy: bool) -> None:
        now = time.monotonic()
        for outgoing in self._outbox:
            if not outgoing.waiting:
                outgoing.since = now
            elif lazy or not outgoing.lazy or now - outgoing.since > _HELD_MAX_S:
                outgoing.put(bundle(outgoing.waiting))
                outgoing.waiting.clear()
                outgoing.since = now

    def _patience_s(self, timeout_s: float) -> float:
        held_back = self.direct or any(outgoing.waiting for outgoing in self._outbox)
        return min(timeout_s, _IDLE_S) if held_back else timeout_s

    def _at_once(self, handle: Callable[..., None]) -> Any:
        inbox, lock = self._inbox, self._lock
        known: set[int] = set()

        def take(event: Any) -> None:
            if threading.get_ident() not in known:
                known.add(threading.get_ident())
                _keep_thread_state()
            with lock:
                if self._failed:
                    return
                try:
                    with np.errstate(all="ignore"):  # as in the thread that calls run
                        handle(event)
                except Exception as error:
                    self._failed = True
                    inbox.put((_raise, error))

        return zenoh.handlers.Callback(take, indirect=False)

    def _into_inbox(self, handle: Callable[..., None]) -> Any:
        inbox = self._inbox

        def put(event: Any) -> None:
            while inbox.qsize() >= INBOX_MAX:
                time.sleep(0.001)
            inbox.put((handle, event))

        return zenoh.handlers.Callback(put, indirect=False)


def _keep_thread_state() -> None:
    """Of a thread that is not Python's: it would be made and freed in every call, and with it memory be mapped."""
    ctypes.pythonapi.PyGILState_Ensure()


def _obey(order: Callable[[], None]) -> None:
    order()


def _raise(error: Exception) -> None:
    raise error
