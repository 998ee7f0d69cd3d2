"""A role's end of the bus: typed, numbered, checked."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import replace
from functools import partial
from typing import Any, Protocol, TypeVar

from numpy.typing import NDArray

from testbed.wire.bus import Bus, Publish
from testbed.wire.codec import Arrays, Decoder, PacketEncoder, Rejected, Sizes, encode
from testbed.wire.keys import Keys
from testbed.wire.messages import Command, Message, Packet, Status

M = TypeVar("M", bound=Message)
PacketHandler = Callable[[M, dict[str, NDArray[Any]]], None]

ORCHESTRATOR = "orchestrator"


class Gate:
    """Lets packets pass from some step on: of a role that joins while the run goes.

    passed_over: packets of each block of lanes that are of no interest, counted from the first of the run; None: all.
    """

    def __init__(self, passed_over: int | None = None) -> None:
        self.passed_over = passed_over
        self.gone_by = 0
        """Packets of a block and key that nobody can have any more: of the block that is furthest."""
        self._kept: list[Callable[[], None]] | None = None

    def keep(self) -> None:
        """Keep what comes from now on until it opens."""
        self._kept = []

    def keeps(self, packet: Packet, take: Callable[[], None]) -> bool:
        """Whether a packet that comes to the closed gate is kept."""
        if self._kept is None:
            self.gone_by = max(self.gone_by, packet.step - packet.FIRST_STEP + 1)
            return False
        self._kept.append(take)
        return True

    def open(self, passed_over: int) -> None:
        """Let pass what is of interest, and first what was kept of it."""
        kept, self._kept, self.passed_over = self._kept or [], None, passed_over
        for take in kept:
            take()


OPEN = Gate(0)


class Send(Protocol):
    """Publishes one packet."""

    def __call__(self, step: int, lane: int, lanes: int, arrays: Arrays) -> None: ...


class Node:
    """What every role has: its name, the run's keys, checked subscriptions, and the count of what it refused.

    tap: number of lanes (from lane 0) of which packets are copied for the recording; 0 for none.
    """

    def __init__(self, bus: Bus, run: str, name: str, sizes: Sizes, tap: int = 0) -> None:
        self.bus, self.run, self.name, self.sizes = bus, run, name, sizes
        self.keys = Keys(run)
        self.rejected: Counter[str] = Counter()
        self.stopped = False
        self.payload = b""
        """The message that is being handled."""
        self.leaving = ExitStack()
        """What is to be done when the role leaves."""
        self._tap = tap
        self._blocks = -(-sizes.lanes // (sizes.lanes_per_packet or sizes.lanes))
        self._status_seq = 0
        self._status = bus.publisher(self.keys.status(name))
        if name != ORCHESTRATOR:
            self.on(self.keys.command, Command, ORCHESTRATOR, self._obey)

    def sender(
        self, key: str, model: type[Packet], *, tap: bool = False, lazy: bool = False, gate: Gate = OPEN
    ) -> Send:
        """A function that publishes packets of one type on one key, numbered.

        tap: copy them for the recording. lazy: nothing waits for them (see Bus.publisher). gate: packets that it did
        not send, or that somebody else sent, and that count in the numbers.
        """
        encoder = PacketEncoder(model, self.run, self.name)
        send = _numbered(self.bus.publisher(key, lazy=lazy), encoder, gate, self._blocks)
        if not tap or not self._tap or self._tap >= self.sizes.lanes:
            return send
        encoder = PacketEncoder(model, self.run, self.name)
        copy = _numbered(self.bus.publisher(self.keys.tap(key), lazy=True), encoder, OPEN, 0)
        recorded = self._tap

        def send_both(step: int, lane: int, lanes: int, arrays: Arrays) -> None:
            send(step, lane, lanes, arrays)
            if lane < recorded:
                kept = min(lanes, recorded - lane)
                copy(step, lane, kept, {name: array[:kept] for name, array in arrays.items()})

        return send_both

    def on(
        self,
        key: str,
        model: type[M],
        source: str | Callable[[M], bool],
        handler: PacketHandler[M],
        *,
        needs: tuple[str, ...] = (),
        last: int | None = None,
        cut: bool = False,
        gate: Gate = OPEN,
    ) -> None:
        """Call ``handler(header, arrays)`` for each valid message of ``source`` on ``key``; count the others.

        Packets come as the run splits the lanes, and the steps of each block one after the other.

        source: the role that sends here, or what says of a header whether its sender is right. needs: arrays that a
        packet must have here. last: the last step, where it is not that of the run. cut: packets hold the recorded
        lanes only. gate: the packets that are passed over at first; the first that is taken has the number that it
        must have had all before it come, or follows on the one that was seen before.
        """
        sizes = self.sizes if last is None else replace(self.sizes, steps=last)
        decoder, turns = Decoder(model, self.run, sizes), _Turns(None if cut else sizes.lanes_per_packet, sizes.lanes)
        is_source = source if callable(source) else partial(_is_from, source)
        expected = 0 if gate.passed_over == 0 else None

        def receive(key: str, payload: bytes) -> None:
            nonlocal expected
            for message, outcome in decoder.read(payload):
                try:
                    if isinstance(outcome, Rejected):
                        raise outcome
                    header, arrays = outcome
                    early = False
                    if gate is not OPEN and isinstance(header, Packet):
                        if gate.passed_over is None:
                            if not gate.keeps(header, partial(receive, key, message)):
                                expected = header.seq + 1
                            continue
                        early = header.step - header.FIRST_STEP < gate.passed_over
                        first = turns.begin(gate.passed_over)
                        if expected is None:
                            expected = header.seq if early else first
                    if not is_source(header):
                        raise Rejected("source", f"from {header.source}")
                    if header.seq != expected:
                        raise Rejected("sequence", f"number {header.seq}, expected {expected}")
                    if early:
                        expected += 1
                        continue
                    for name in needs:
                        if name not in arrays:
                            raise Rejected("arrays", f"lacks {name}")
                    if isinstance(header, Packet):
                        turns.check(header)
                except Rejected as refusal:
                    self.rejected[refusal.reason] += 1
                    continue
                expected += 1
                self.payload = message
                handler(header, arrays)

        self.bus.subscribe(key, receive)

    def announce(self) -> None:
        """Say that this role is ready: all its subscriptions are declared."""
        self.bus.announce(self.keys.presence(self.name))

    def report(self, state: Any, counters: dict[str, int], detail: str = "") -> None:
        """Tell the orchestrator how this role ended."""
        status = Status(
            run=self.run,
            source=self.name,
            seq=self._status_seq,
            state=state,
            detail=detail[:2000],
            counters=counters,
            rejected=dict(self.rejected),
        )
        self._status_seq += 1
        self._status(encode(status))

    def _obey(self, command: Command, _: dict[str, NDArray[Any]]) -> None:
        if command.action == "stop":
            self.stopped = True


class _Turns:
    """Which packets are due on one key: whole blocks of lanes, the steps of each in order."""

    def __init__(self, per_packet: int | None, lanes: int) -> None:
        self._per_packet, self._lanes = per_packet, lanes
        self._due: dict[int, int] = {}
        self._passed_over = 0

    def begin(self, passed_over: int) -> int:
        """Let so many packets of each block be done; the number of the next one on the key, where all are done."""
        self._passed_over = passed_over
        return passed_over * len(range(0, self._lanes, self._per_packet or self._lanes))

    def check(self, packet: Packet) -> None:
        lane, size = packet.lane, self._per_packet
        if size is not None and (lane % size or packet.lanes != min(size, self._lanes - lane)):
            raise Rejected("range", f"lanes {lane}…{lane + packet.lanes - 1} are not a packet of this run")
        step, due = packet.step, self._due.get(lane)
        if due is None:
            due = packet.FIRST_STEP + self._passed_over
        if step != due:
            raise Rejected("order", f"step {step}, expected {due}")
        self._due[lane] = due + 1


def _is_from(source: str, header: Message) -> bool:
    return header.source == source


def _numbered(publish: Publish, encoder: PacketEncoder, gate: Gate, blocks: int) -> Send:
    seq = 0 if gate.passed_over == 0 else -1

    def send(step: int, lane: int, lanes: int, arrays: Arrays) -> None:
        nonlocal seq
        if seq < 0:
            seq = (gate.passed_over or 0) * blocks
        publish(encoder.encode(seq, step, lane, lanes, arrays))
        seq += 1

    return send
