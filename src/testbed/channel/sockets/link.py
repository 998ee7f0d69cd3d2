"""What a UDP relay and a TCP proxy share: two pipelines, a thread, books, changes while they run."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal, Self

from testbed.channel.pipeline import Pipeline
from testbed.channel.sockets.loop import LinkFailed, Loop
from testbed.channel.sockets.tracing import TraceWriter
from testbed.errors import UsageError, did_you_mean
from testbed.scenario.links import Impairments

Direction = Literal["forward", "backward"]
DIRECTIONS: tuple[Direction, Direction] = ("forward", "backward")
COMPONENTS = ("link.relay.forward", "link.relay.backward")


@dataclass(frozen=True)
class Figures:
    """Books of a link: packets by direction as ``Books`` counts them, and what happened around them."""

    directions: dict[str, dict[str, int]]
    around: dict[str, int] = field(default_factory=dict)

    def to_json(self) -> dict[str, Any]:
        return {**self.directions, **self.around}


class SocketLink:
    """A link between real sockets, to be used in ``with``: it begins at the entry and ends at the exit.

    address: where clients connect, host and port.
    The forward direction is from the clients to the target. Simulated time is the time since the link was made.
    """

    address: tuple[str, int]

    def __init__(
        self,
        name: str,
        impairments: tuple[Impairments, Impairments],
        seed: int,
        components: tuple[str, str],
        traces: dict[Direction, Path] | None,
    ) -> None:
        for settings in impairments:
            self.check(settings)
        self._seed, self._components = seed, dict(zip(DIRECTIONS, components, strict=True))
        self._pipelines = {
            direction: self._pipeline(direction, settings)
            for direction, settings in zip(DIRECTIONS, impairments, strict=True)
        }
        self._traces = {direction: TraceWriter(path) for direction, path in (traces or {}).items()}
        self._loop = Loop(name, self._due)
        self._closed = False

    def _pipeline(self, direction: Direction, settings: Impairments) -> Pipeline:
        return Pipeline(settings, self._seed, self._components[direction])

    @staticmethod
    def check(settings: Impairments) -> None:
        """Raises UsageError for impairments that this link cannot express."""

    def change(self, direction: Direction, settings: Impairments) -> None:
        """Other impairments from the next packet on, from any thread; nothing in flight is touched, no draw repeated.

        Raises UsageError for an unknown direction or impairments that this link cannot express.
        """
        if direction not in DIRECTIONS:
            raise UsageError(
                f"direction {direction!r}: allowed: forward, backward{did_you_mean(direction, DIRECTIONS)}"
            )
        self.check(settings)
        self._loop.call(lambda: self._pipelines[direction].change(settings))

    def figures(self) -> Figures:
        """The books of this moment, or of the end."""
        return self._loop.call(self._figures)

    def wait(self, seconds: float | None = None) -> bool:
        """Whether the link ended within so many seconds; it does by ``close`` only. Raises LinkFailed if it broke."""
        return self._loop.wait(seconds)

    def close(self) -> None:
        """End the thread and close every socket and file; what is in flight stays so in the books.

        Raises LinkFailed if the link had broken, or if its books do not balance.
        """
        if self._closed:
            return
        self._closed = True
        try:
            self._loop.stop()
            for direction, pipeline in self._pipelines.items():
                if pipeline.books.in_flight != self._held(direction):
                    raise LinkFailed(
                        f"{direction}: the books have {pipeline.books.in_flight} packets in flight; "
                        f"on their way are {self._held(direction)}"
                    )
        finally:
            self._close_sockets()
            self._end()
            for trace in self._traces.values():
                trace.close()

    def __enter__(self) -> Self:
        self._loop.start()
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _figures(self) -> Figures:
        books = {str(direction): pipeline.books.as_counters() for direction, pipeline in self._pipelines.items()}
        return Figures(books, self._around())

    def _due(self, now_ns: int) -> int | None:
        """Do what is due; when to be called next."""
        raise NotImplementedError

    def _around(self) -> dict[str, int]:
        raise NotImplementedError

    def _held(self, direction: Direction) -> int:
        """Packets on their way."""
        raise NotImplementedError

    def _close_sockets(self) -> None:
        raise NotImplementedError

    def _end(self) -> None:
        """Write what is in flight into the traces."""
        raise NotImplementedError
