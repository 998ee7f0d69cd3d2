"""Faults that no scenario can express, on the in-process bus, each after a number of messages."""

from __future__ import annotations

import random
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Protocol, TypeVar


class Victim(Protocol):
    @property
    def role(self) -> str: ...


V = TypeVar("V", bound=Victim)
PACKETS = ("sent", "delivered")
"""Last parts of keys of packets; other messages come twice only at once, as a network may double them."""


@dataclass(frozen=True)
class Kill:
    """A role dies: at once, or as it is about to publish its next but ``after`` message, in the middle of what it does.

    which: a number 0 … 1 that picks it from those that are there; "again": the one that died last, if it is back;
    "newest": the one that joined last. together: how many die at the same moment. lost: the share of what nobody has
    received yet that is lost.
    """

    at: int
    which: float | str
    after: int | None = None
    together: int = 1
    share: float = 1.0

    def victims(self, there: Sequence[V], last: str | None) -> list[V]:
        if not there:
            return []
        if self.which == "again":
            return [victim for victim in there if victim.role == last]
        if self.which == "newest":
            return [there[-1]]
        place = int(float(self.which) * len(there))
        return [there[(place + i * 2) % len(there)] for i in range(min(self.together, (len(there) + 1) // 2))]

    def lost(self, fresh: int) -> int:
        return round(self.share * fresh)


@dataclass(frozen=True)
class Stall:
    """A role gets nothing for so many messages, or until nobody else has anything to do."""

    at: int
    which: float
    lasts: int

    def victims(self, there: Sequence[V], _: str | None) -> list[V]:
        return [there[int(self.which * len(there))]] if there else []


@dataclass(frozen=True)
class Repeat:
    """A message that was sent before comes a second time."""

    at: int
    key: float
    back: float
    """0 … 1: how long ago it was sent."""

    def pick(self, seen: Mapping[str, Sequence[bytes]]) -> list[tuple[str, bytes]]:
        keys = sorted(seen)
        if not keys:
            return []
        key = keys[int(self.key * len(keys))]
        is_packet = key.rsplit("/", 1)[1] in PACKETS or key.rsplit("/", 2)[-2] == "estimate"
        messages = seen[key]
        return [(key, messages[-1 - int(self.back * len(messages)) if is_packet else -1])]


@dataclass(frozen=True)
class Garbage:
    """Something that is no message of the run comes on a key of it."""

    at: int
    key: float
    form: int
    seed: int
    made_from: dict[str, str] = field(default_factory=dict, compare=False)

    def made(self, seen: Mapping[str, Sequence[bytes]]) -> list[tuple[str, bytes]]:
        keys = sorted(seen)
        if not keys:
            return []
        draw = random.Random(self.seed)
        key = keys[int(self.key * len(keys))]
        message = bytes(draw.choice(seen[key]))
        forms = (
            lambda: b"",
            lambda: draw.randbytes(draw.randint(1, 200)),
            lambda: message[: draw.randrange(len(message))],
            lambda: bytes(4) + message[4:],
            lambda: message[:8] + message[8:].replace(b'"run":"', b'"run":"z', 1),
            lambda: message + draw.randbytes(3),
        )
        return [(key, forms[self.form % len(forms)]())]


Disturbance = Kill | Stall | Repeat | Garbage


def disturbances(draw: random.Random, messages: int) -> list[Disturbance]:
    """What happens in a run that takes about so many messages without them."""
    out: list[Disturbance] = []
    for _ in range(draw.choice((1, 1, 2, 3, 5))):
        at = draw.randrange(messages)
        after = draw.choice((None, None, 0, 1, 2))
        which = "newest" if draw.random() < 0.1 else draw.random()
        out.append(Kill(at, which, after, draw.choice((1, 1, 1, 2, 3)), round(draw.random(), 2)))
        while draw.random() < 0.3:
            at += draw.randint(0, 40)
            out.append(Kill(at, "again", draw.choice((None, None, 0, 1)), share=round(draw.random(), 2)))
    for _ in range(draw.choice((0, 1, 3))):
        out.append(Stall(draw.randrange(messages), draw.random(), draw.randint(5, 300)))
    for _ in range(draw.choice((0, 0, 3))):
        out.append(Repeat(draw.randrange(messages), draw.random(), draw.random()))
    for _ in range(draw.choice((0, 0, 3))):
        out.append(Garbage(draw.randrange(messages), draw.random(), draw.randrange(6), draw.randrange(2**31)))
    return sorted(out, key=lambda one: one.at)
