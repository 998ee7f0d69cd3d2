"""A role's end of the bus: typed, numbered, checked."""

from __future__ import annotations

import json
from collections import Counter, deque
from collections.abc import Callable, Collection
from contextlib import ExitStack, suppress
from dataclasses import replace
from functools import partial
from typing import Any, Protocol, TypeVar

from numpy.typing import NDArray

from testbed.errors import RunFailed, UsageError
from testbed.wire.begin import AT_START, Begin, Given
from testbed.wire.bundle import bundle
from testbed.wire.bus import Bus, BusError, Publish
from testbed.wire.codec import Arrays, Decoder, PacketEncoder, Rejected, Sizes, encode
from testbed.wire.keys import Keys
from testbed.wire.messages import Change, Command, Message, Packet, Status

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
        self._kept = self._kept or []

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


class Restorable(Protocol):
    """A service whose blocks of lanes can give their state after a step, and take it back."""

    @property
    def gives_state(self) -> bool: ...

    def state(self, lane: int) -> bytes: ...

    def resume(self, lane: int, step: int, state: bytes) -> None: ...


class Node:
    """What every role has: its name, the run's keys, checked subscriptions, and the count of what it refused.

    tap: number of lanes (from lane 0) of which packets are copied for the recording; 0 for none. begin: where the role
    begins. every: after so many steps each it gives its state; 0: never. kept: keys of which the role keeps what it
    sends, for those that begin late, until it is told to forget.
    """

    def __init__(
        self,
        bus: Bus,
        run: str,
        name: str,
        sizes: Sizes,
        tap: int = 0,
        *,
        begin: Begin = AT_START,
        every: int = 0,
        kept: Collection[str] = (),
    ) -> None:
        self.bus, self.run, self.name, self.sizes, self.begin = bus, run, name, sizes, begin
        self.keys = Keys(run)
        self.rejected: Counter[str] = Counter()
        self.repeated = 0
        """Messages that had come before."""
        self.stopped = False
        self.payload = b""
        """The message that is being handled."""
        self.leaving = ExitStack()
        """What is to be done when the role leaves."""
        self._tap = tap
        self._blocks = _blocks(sizes.lanes, sizes)
        self._from = Gate(begin.step) if begin.step else OPEN
        self._every, self._service = every, _NO_SERVICE
        self._keeps, self._sent = frozenset(kept), dict[str, _Kept]()
        self._forgotten = 0
        self._inputs: dict[str, _Input] = {}
        self._held: list[tuple[_Input, bytes]] | None = [] if begin.late else None
        self._status_seq = 0
        self._status = bus.publisher(self.keys.status(name))
        if name != ORCHESTRATOR:
            self._give = bus.publisher(self.keys.state(name), lazy=True) if every else None
            self.on(self.keys.command, Command, ORCHESTRATOR, self._obey, first=None)

    def sender(
        self, key: str, model: type[Packet], *, tap: bool = False, lazy: bool = False, gate: Gate = OPEN
    ) -> Send:
        """A function that publishes packets of one type on one key, numbered.

        tap: copy them for the recording. lazy: nothing waits for them (see Bus.publisher). gate: packets that it did
        not send, or that somebody else sent, and that count in the numbers.
        """
        encoder = PacketEncoder(model, self.run, self.name)
        gate = self._from if gate is OPEN else gate
        kept = self._keep(key, gate) if key in self._keeps else None
        send = _numbered(self.bus.publisher(key, lazy=lazy), encoder, gate, self._blocks, kept)
        if not tap or not self._tap or self._tap >= self.sizes.lanes:
            return send
        encoder = PacketEncoder(model, self.run, self.name)
        blocks = _blocks(self._tap, self.sizes)
        copy = _numbered(self.bus.publisher(self.keys.tap(key), lazy=True), encoder, self._from, blocks, None)
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
        first: int | None = 0,
    ) -> None:
        """Call ``handler(header, arrays)`` for each valid message of ``source`` on ``key``; count the others.

        Packets come as the run splits the lanes, and the steps of each block one after the other. What has come before
        with the same number is passed over and counted: a role that was started anew sends it again.

        source: the role that sends here, or what says of a header whether its sender is right. needs: arrays that a
        packet must have here. last: the last step, where it is not that of the run. cut: packets hold the recorded
        lanes only. gate: the packets that are passed over at first; the first that is taken has the number that it
        must have had all before it come, or follows on the one that was seen before. first: the number of the first
        message that is no packet; None: any, as in a role that begins late.
        """
        sizes = self.sizes if last is None else replace(self.sizes, steps=last)
        gate = self._from if gate is OPEN else gate
        decoder, turns = Decoder(model, self.run, sizes), _Turns(None if cut else sizes.lanes_per_packet, sizes.lanes)
        is_source = source if callable(source) else partial(_is_from, source)
        is_packet = issubclass(model, Packet)
        if is_packet:
            first = 0 if gate.passed_over == 0 else None
        elif self.begin.late:
            first = 0 if model is Change else None
        due = self._inputs[key] = _Input(key, first, of_changes=model is Change, turns_change=callable(source))
        blocks = _blocks(self._tap, self.sizes) if cut else None

        def receive(payload: bytes) -> None:
            for message, outcome in decoder.read(payload):
                try:
                    if isinstance(outcome, Rejected):
                        raise outcome
                    header, arrays = outcome
                    early = False
                    if gate is not OPEN and isinstance(header, Packet):
                        if gate.passed_over is None:
                            if not gate.keeps(header, partial(receive, message)):
                                due.number = max(due.number or 0, header.seq + 1)
                            continue
                        early = header.step - header.FIRST_STEP < gate.passed_over
                        begun = turns.begin(gate.passed_over, blocks)
                        if due.number is None:
                            due.number = header.seq if early else begun
                    elif due.number is None and is_source(header):
                        due.number = header.seq
                    if not is_source(header):
                        raise Rejected("source", f"from {header.source}")
                    if due.number is not None and header.seq < due.number:
                        self.repeated += 1
                        continue
                    if header.seq != due.number:
                        raise Rejected("sequence", f"number {header.seq}, expected {due.number}")
                    if early:
                        turns.check_early(header)
                        due.number += 1
                        continue
                    for name in needs:
                        if name not in arrays:
                            raise Rejected("arrays", f"lacks {name}")
                    if isinstance(header, Packet):
                        turns.check(header)
                except Rejected as refusal:
                    self.rejected[refusal.reason] += 1
                    continue
                due.number += 1
                self.payload = message
                handler(header, arrays)

        def hold(_: str, payload: bytes) -> None:
            if self._held is None:
                receive(payload)
            else:
                self._held.append((due, payload))

        def take(_: str, payload: bytes) -> None:
            receive(payload)

        due.receive = receive
        self.bus.subscribe(key, hold if self._held is not None and is_packet and not cut else take)

    def serve(self, service: object) -> None:
        """Say what service this is the node of; where it begins with a state, it is given that.

        Before that it is told of the changes that were made.
        """
        for due in self._inputs.values():
            if due.of_changes:
                for message in self.begin.changes:
                    due.receive(message)
        if getattr(service, "gives_state", False):
            self._service = service  # type: ignore[assignment]
            for lane, state in self.begin.states.items():
                self._service.resume(lane, self.begin.step, state)

    def done(self, step: int, lane: int) -> None:
        """A block of lanes has done a step, and sent everything of it: give its state if it is time for that."""
        if self._every and not step % self._every and self._service is not _NO_SERVICE and self._give is not None:
            given = Given(role=self.name, step=step, lane=lane, life=self.begin.life)
            self._give(given.with_data(self._service.state(lane)))

    def catch_up(self) -> None:
        """Of a role that begins late: take what was sent before it listened, and then what has come since.

        Raises RunFailed where that is not there any more.
        """
        if self._held is None:
            return
        told = [(due, payload) for due in self._inputs.values() for payload in self._history_of(due)]
        self.bus.call(partial(self._work_off, told))

    def _history_of(self, due: _Input) -> list[bytes]:
        """What the sender on a key has sent since this role's beginning; nothing where nobody keeps it."""
        if due.key not in self._keeps:
            return []
        question = json.dumps({"since": self.begin.step * self._blocks}).encode()
        told: list[bytes] = []
        for key in (self.keys.history(due.key), *([self.keys.earlier(due.key)] if due.turns_change else ())):
            with suppress(BusError):
                answer = self.bus.ask(key, question)
                if answer[:1] == b"{":
                    raise RunFailed(f"{due.key}: {json.loads(answer)['error']}")
                if answer:
                    told.insert(0, answer)
        return told

    def _work_off(self, told: list[tuple[_Input, bytes]]) -> None:
        held, self._held = self._held or [], None
        for due, payload in [*told, *held]:
            due.receive(payload)

    def _keep(self, key: str, gate: Gate) -> _Kept:
        """What goes out on a key; it can be asked for once it is known from where on that is this role's."""
        if key not in self._sent:
            sent = self._sent[key] = _Kept()
            sent.answered = partial(self.bus.answer, self.keys.history(key), partial(self._told, sent))
            if gate.passed_over is not None:
                sent.offer()
        return self._sent[key]

    def remember(self, key: str) -> Callable[[int], None]:
        """Keep what is taken on a key on which senders take turns; the function that does so with a number.

        To be called while the message is handled.
        """
        taken = self._sent[key] = _Kept()
        self.bus.answer(self.keys.earlier(key), partial(self._told, taken))
        return lambda seq: taken.append((seq, self.payload))

    def forget(self, step: int) -> None:
        """Nobody will ask for what belongs to the first so many steps."""
        self._forgotten = step * self._blocks
        for sent in self._sent.values():
            while sent and sent[0][0] < self._forgotten:
                sent.popleft()

    def _told(self, sent: _Kept, question: bytes) -> bytes:
        try:
            since = int(json.loads(question)["since"])
        except (ValueError, KeyError, TypeError):
            return json.dumps({"error": "a question that is not understood"}).encode()
        if since < self._forgotten:
            return json.dumps({"error": f"kept from number {self._forgotten} on, asked for {since}"}).encode()
        messages = [message for seq, message in sent if seq >= since]
        return bundle(messages) if messages else b""

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
            repeated=self.repeated,
        )
        self._status_seq += 1
        self._status(encode(status))

    def expect_anew(self, key: str) -> None:
        """The sender of messages that are no packets is started anew, and counts them from 0."""
        self._inputs[key].number = 0

    def _obey(self, command: Command, _: dict[str, NDArray[Any]]) -> None:
        if command.action == "stop":
            self.stopped = True
        elif command.action == "ping":
            self.report("alive", {})
        else:
            self.forget(command.step or 0)


class _Kept(deque[tuple[int, bytes]]):
    """Messages with their numbers; ``offer``: they can be asked for from now on."""

    answered: Callable[[], None] | None = None

    def offer(self) -> None:
        if self.answered is not None:
            self.answered()
            self.answered = None


class _Input:
    """What is due on a key that a role listens to: the number of the next message, None until the first has come."""

    def __init__(self, key: str, number: int | None, *, of_changes: bool, turns_change: bool) -> None:
        self.key, self.number, self.of_changes, self.turns_change = key, number, of_changes, turns_change
        self.receive: Callable[[bytes], None] = lambda payload: None


class _NoService:
    gives_state = False

    def state(self, lane: int) -> bytes:
        raise UsageError("there is no service")

    def resume(self, lane: int, step: int, state: bytes) -> None:
        raise UsageError("there is no service")


_NO_SERVICE: Restorable = _NoService()


class _Turns:
    """Which packets are due on one key: whole blocks of lanes, the steps of each in order."""

    def __init__(self, per_packet: int | None, lanes: int) -> None:
        self._per_packet, self._lanes = per_packet, lanes
        self._due: dict[int, int] = {}
        self._passed_over = 0

    def begin(self, passed_over: int, blocks: int | None = None) -> int:
        """Let so many packets of each block be done; the number of the next one on the key, where all are done.

        blocks: how many there are, where not all lanes come.
        """
        self._passed_over = passed_over
        every = len(range(0, self._lanes, self._per_packet or self._lanes))
        return passed_over * (every if blocks is None else blocks)

    def check_early(self, packet: Message) -> None:
        """Of a packet from before the beginning: none of its block from behind it has come."""
        if isinstance(packet, Packet) and packet.lane in self._due:
            raise Rejected("order", f"step {packet.step}, expected {self._due[packet.lane]}")

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


def _blocks(lanes: int, sizes: Sizes) -> int:
    """Packets of a step that hold the first so many lanes."""
    return -(-lanes // (sizes.lanes_per_packet or sizes.lanes))


def _numbered(publish: Publish, encoder: PacketEncoder, gate: Gate, blocks: int, kept: _Kept | None) -> Send:
    seq = 0 if gate.passed_over == 0 else -1

    def send(step: int, lane: int, lanes: int, arrays: Arrays) -> None:
        nonlocal seq
        if seq < 0:
            seq = (gate.passed_over or 0) * blocks
        message = encoder.encode(seq, step, lane, lanes, arrays)
        if kept is not None:
            kept.append((seq, message))
            kept.offer()
        publish(message)
        seq += 1

    return send
