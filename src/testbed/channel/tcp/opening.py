"""How a connection is opened: round trips that are repeated until they succeed, and attempts until one does."""

from __future__ import annotations

from collections.abc import Callable

_FIRST_NS = 1_000_000_000
_LINEAR = 4  # repetitions a second apart, before the pauses double (Linux, tcp_syn_linear_timeouts)


class Opening:
    """request: called with the step and the time, to send what the other end answers with that step.

    round_trip_ns: of the last step, None if it was repeated. opened_ns: when the last answer came, None before.
    """

    def __init__(
        self, steps: int, limit_ns: int, retry_ns: int, request: Callable[[int, int], None], now_ns: int
    ) -> None:
        self._steps, self._limit_ns, self._retry_ns, self._request = steps, limit_ns, retry_ns, request
        self.attempts = 0
        self.round_trip_ns: int | None = None
        self.opened_ns: int | None = None
        self.deadline_ns = now_ns
        self._step = -1
        self._begin(now_ns)

    def _begin(self, now_ns: int) -> None:
        self.attempts += 1
        self._until_ns = now_ns + self._limit_ns
        self._base = self._step + 1  # answers to earlier attempts do not count
        self._ask(now_ns)

    def _ask(self, now_ns: int) -> None:
        self._step += 1
        self._asked_ns, self._repeats, self._pause_ns = now_ns, 0, _FIRST_NS
        self._send(now_ns)

    def _send(self, now_ns: int) -> None:
        self.deadline_ns = min(now_ns + self._pause_ns, self._until_ns)
        self._request(self._step, now_ns)

    def timeout(self, now_ns: int) -> None:
        """`deadline_ns` has come: repeat the request, give the attempt up, or begin the next."""
        if now_ns < self._until_ns:
            self._repeats += 1
            if self._repeats > _LINEAR:
                self._pause_ns *= 2
            self._send(now_ns)
        elif now_ns < self._until_ns + self._retry_ns:
            self.deadline_ns = self._until_ns + self._retry_ns
        else:
            self._begin(now_ns)

    def answered(self, step: int, now_ns: int) -> None:
        """The other end's answer arrives."""
        if step != self._step or now_ns >= self._until_ns:
            return
        self.round_trip_ns = None if self._repeats else now_ns - self._asked_ns
        if step - self._base + 1 >= self._steps:
            self.opened_ns = now_ns
        else:
            self._ask(now_ns)
