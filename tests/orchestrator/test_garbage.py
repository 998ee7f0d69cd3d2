"""Garbage on every key of a run changes no figure, stops nothing, and is counted to the last message."""

from __future__ import annotations

import json
import random
from pathlib import Path
from typing import Any

import pytest

from orchestrator.runs import figures, run, scenario
from testbed.wire.memory_bus import MemoryNetwork

INJECTIONS = 1500


def rewritten(payload: bytes, **changes: Any) -> bytes:
    """The payload with some fields of its header changed."""
    end = 8 + int.from_bytes(payload[4:8], "little")
    header = {**json.loads(payload[8:end]), **changes}
    text = json.dumps({key: value for key, value in header.items() if value is not None}).encode()
    text += b" " * (-len(text) % 8)
    return b"NCS1" + len(text).to_bytes(4, "little") + text + payload[end:]


def spoilt(payload: bytes, value: bytes) -> bytes:
    """The payload with the first eight bytes behind its header replaced."""
    end = 8 + int.from_bytes(payload[4:8], "little")
    return payload[:end] + value + payload[end + 8 :]


NAN, INF = b"\0\0\0\0\0\0\xf8\x7f", b"\0\0\0\0\0\0\xf0\x7f"


def flipped(payload: bytes, rng: random.Random) -> bytes:
    damaged = bytearray(payload)
    damaged[rng.randrange(len(damaged))] ^= 1 << rng.randrange(8)
    return bytes(damaged)


class Noisy(MemoryNetwork):
    """While the run goes on, publishes garbage between its messages: rubbish, damage, replays, gaps, forgeries."""

    current: Noisy

    def __init__(self, seed: int | None = None, **rest: Any) -> None:
        super().__init__(seed, **rest)
        type(self).current = self
        self.rng = random.Random(1)
        self.seen: dict[str, list[bytes]] = {}
        self.injected: dict[str, int] = {}
        self.arrivals = 0

    def _publish(self, key: str, payload: bytes) -> None:
        self.seen.setdefault(key, []).append(payload)
        super()._publish(key, payload)

    def step(self) -> bool:
        if self.seen and sum(self.injected.values()) < INJECTIONS:
            self._inject(self.rng.choice(sorted(self.all_keys())))
        return super().step()

    def all_keys(self) -> set[str]:
        """Every key that somebody listens to or publishes on."""
        return {key for key, _, _ in self._subscribers} | set(self.seen)

    def _inject(self, key: str) -> None:
        genuine = self.seen.get(key) or self.rng.choice(list(self.seen.values()))
        payload = self._garbage(self.rng.choice(genuine), self.rng.choice(self.rng.choice(list(self.seen.values()))))
        self.injected[key] = self.injected.get(key, 0) + 1
        self.arrivals += sum(listened == key for listened, _, _ in self._subscribers)
        super()._publish(key, payload)

    def _garbage(self, genuine: bytes, foreign: bytes) -> bytes:
        """`genuine` was on the key before (or nothing was); `foreign` is of any key."""
        rng = self.rng
        return rng.choice(
            [
                rng.randbytes(rng.randrange(100)),
                b"",
                genuine,
                genuine[: rng.randrange(len(genuine))],
                genuine + b"\0" * 8,
                flipped(genuine, rng),
                rewritten(genuine, run="another0run0"),
                rewritten(genuine, source="somebody"),
                rewritten(genuine, seq=10**6),
                rewritten(genuine, seq=10**6, step=3),
                rewritten(genuine, v=2),
                rewritten(genuine, type=None),
                rewritten(genuine, lane=10**9),
                rewritten(genuine, seq=-1),
                rewritten(genuine, arrays=[["x", "<f8", [10**9]]]),
                spoilt(genuine, NAN),
                spoilt(genuine, INF),
                rewritten(foreign, source="somebody", seq=0),
                b"NCS1" + (2**32 - 1).to_bytes(4, "little"),
                b"NCS1" + (2**14).to_bytes(4, "little") + b"[" * 2**14,
            ]
        )


@pytest.mark.parametrize("schedule", [None, 5])
@pytest.mark.parametrize("lanes_per_packet", [6, 2])
def test_garbage_changes_no_figure_and_is_counted(schedule: int | None, lanes_per_packet: int, tmp_path: Path) -> None:
    given = scenario(transport={"lanes_per_packet": lanes_per_packet}, clock={"window": 3})
    clean = run(given, tmp_path / "clean")
    noisy = run(given, tmp_path / "noisy", schedule, Noisy)
    network = Noisy.current
    assert noisy.status == "complete"
    assert {**figures(noisy), "rejected": {}, "repeated": {}} == figures(clean)
    assert sum(network.injected.values()) == INJECTIONS
    assert set(network.injected) >= {key for key in network.all_keys() if "status" not in key}
    refused = sum(sum(reasons.values()) for reasons in noisy.rejected.values())
    assert refused + sum(noisy.repeated.values()) == network.arrivals
    reasons = {reason for of_role in noisy.rejected.values() for reason in of_role}
    assert reasons >= {"format", "schema", "run", "source", "sequence", "finite", "range"}


@pytest.mark.parametrize("schedule", [None, 5])
def test_garbage_does_not_disturb_a_closed_loop(schedule: int | None, tmp_path: Path) -> None:
    given = scenario(input={"kind": "feedback", "gain": [[0.6, 0.3]]})
    clean = run(given, tmp_path / "clean")
    noisy = run(given, tmp_path / "noisy", schedule, Noisy)
    assert {**figures(noisy), "rejected": {}, "repeated": {}} == figures(clean)
    refused = sum(sum(reasons.values()) for reasons in noisy.rejected.values())
    assert refused + sum(noisy.repeated.values()) == Noisy.current.arrivals
