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
from testbed.wire.timers import Timers, WallClock

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
    in flight, in a client, whose messages all come over one link. timed: messages carry when they were published, as
    zenoh's timestamps, and nothing is held back. All count for what is declared afterwards.
    """

    def __init__(self, session: zenoh.Session, *, deadline_s: float = 10.0, express: bool = False) -> None:
        self._session, self._deadline_s, self.express = session, deadline_s, express
        self.direct = self.timed = False
        self.published_ns = self.arrived_ns = 0
        self.clock = WallClock()
        self._timers = Timers(self.clock)
        self._lock = threading.Lock()
        self._failed = False
        self._inbox: queue.SimpleQueue[tuple[Callable[..., None], Any]] = queue.SimpleQueue()
        self._declared: list[Any] = []
        self._outbox: list[_Outgoing] = []
        self._handling = False

    def run(self, timeout_s: float) -> bool:
        """Handle what has arrived, waiting up to ``timeout_s`` for the first; False if nothing came.

        Calls that are due come first.
        """
        try:
            handle, event = self._inbox.get(timeout=self._patience_s(timeout_s))
        except queue.Empty:
            self.flush()
            handle, event = _nothing, None
        with self._lock:
            self._handling = True
            try:
                fired = self._timers.fire()
                if handle is _nothing and not fired:
                    return False
                handle(event)
                for _ in range(min(self._inbox.qsize(), _AT_ONCE)):
                    handle, event = self._inbox.get_nowait()
                    self._timers.fire()
                    handle(event)
            finally:
                self._handling = False
                self._send(lazy=False)
        return True

    def flush(self) -> None:
        """Send everything that is held back."""
        with self._lock:
            self._send(lazy=True)

    def at(self, due_ns: int, call: Callable[[], None]) -> None:
        self._timers.at(due_ns, call)
        self._inbox.put((_nothing, None))  # who waits on another thread is to look again

    def publisher(self, key: str, *, lazy: bool = False) -> Publish:
        publisher = self._session.declare_publisher(
            key,
            congestion_control=zenoh.CongestionControl.BLOCK,
            reliability=zenoh.Reliability.RELIABLE,
            express=self.express,
        )
        self._declared.append(publisher)
        put: Publish = publisher.put
        if self.timed:
            return self._timed_put(put)
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

        def handle_timed(arrived: tuple[int, Any]) -> None:
            self.arrived_ns, sample = arrived
            stamp = sample.timestamp
            self.published_ns = self.arrived_ns if stamp is None else stamp.get_time_as_ntp64().as_nanos()
            handle(sample)

        receive = (self._at_once if self.direct else self._into_inbox)(handle_timed if self.timed else handle)
        if self.timed:
            receive = _with_arrival(receive)
        self._declared.append(self._session.declare_subscriber(key, _calling(receive)))

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

        self._declared.append(self._session.declare_queryable(key, _calling(self._into_inbox(reply))))

    def announce(self, key: str) -> None:
        self._declared.append(self._session.liveliness().declare_token(key))

    def watch(self, key: str, handler: PresenceHandler) -> None:
        def handle(sample: Any) -> None:
            handler(str(sample.key_expr), sample.kind == zenoh.SampleKind.PUT)

        liveliness = self._session.liveliness()
        self._declared.append(liveliness.declare_subscriber(key, _calling(self._into_inbox(handle)), history=True))

    def _timed_put(self, put: Callable[..., None]) -> Publish:
        session = self._session
        return lambda payload: put(payload, timestamp=session.new_timestamp())

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
        return min(timeout_s, self._timers.wait_s, _IDLE_S if held_back else timeout_s)

    def _at_once(self, handle: Callable[..., None]) -> Callable[[Any], None]:
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

        return take

    def _into_inbox(self, handle: Callable[..., None]) -> Callable[[Any], None]:
        inbox = self._inbox

        def put(event: Any) -> None:
            while inbox.qsize() >= INBOX_MAX:
                time.sleep(0.001)
            inbox.put((handle, event))

        return put


def _calling(receive: Callable[[Any], None]) -> Any:
    """A handler for zenoh that calls on the thread which receives."""
    return zenoh.handlers.Callback(receive, indirect=False)


def _with_arrival(receive: Callable[[Any], None]) -> Callable[[Any], None]:
    return lambda sample: receive((time.time_ns(), sample))


def _nothing(_: Any) -> None:
    pass


def _keep_thread_state() -> None:
    """Of a thread that is not Python's: it would be made and freed in every call, and with it memory be mapped."""
    ctypes.pythonapi.PyGILState_Ensure()


def _obey(order: Callable[[], None]) -> None:
    order()


def _raise(error: Exception) -> None:
    raise error
