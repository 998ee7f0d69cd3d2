"""The files of a journal, as bytes. No I/O.

``begin.json``: what the run is, one JSON object.
``notes.jsonl``: what happened, a JSON object a line.
``figures.bin``: figures of completed steps, one record after the other: ``after``, ``to`` and a length (uint64,
little-endian), as many bytes, and the BLAKE2b digest (16 bytes) of all that.
``checkpoint-STEP.bin``: ``NCCP``, the digest of the rest, and a bundle of a JSON header, the state of the collector
and the states of the services.
"""

from __future__ import annotations

import json
import re
import struct
from collections.abc import Mapping
from dataclasses import dataclass
from hashlib import blake2b
from typing import Any

from testbed.errors import UsageError
from testbed.wire.bundle import bundle, unbundle

BEGIN, NOTES, FIGURES = "begin.json", "notes.jsonl", "figures.bin"
VERSION = 1
_MAGIC, _DIGEST = b"NCCP", 16
_RECORD = struct.Struct("<QQQ")
_NAME = re.compile(r"checkpoint-(\d{1,10})\.bin")


@dataclass(frozen=True)
class Checkpoint:
    """A run after ``step`` completed steps.

    states: of the services, by role and first lane of the block. collector: its state. facts: what else the
    orchestrator knew.
    """

    step: int
    states: Mapping[tuple[str, int], bytes]
    collector: bytes
    facts: Mapping[str, Any]


@dataclass(frozen=True)
class Figures:
    """The figures of the completed steps after + 1 … to."""

    after: int
    to: int
    content: bytes


def checkpoint_name(step: int) -> str:
    return f"checkpoint-{step}.bin"


def step_of(name: str) -> int | None:
    """The step of the checkpoint that a file of that name holds; None where it is none."""
    match = _NAME.fullmatch(name)
    return int(match[1]) if match else None


def written(checkpoint: Checkpoint) -> bytes:
    """The bytes of a checkpoint; its facts must be what JSON can say."""
    listed = list(checkpoint.states)
    header = {"v": VERSION, "step": checkpoint.step, "states": listed, "facts": checkpoint.facts}
    parts = [json.dumps(header).encode(), checkpoint.collector, *(checkpoint.states[key] for key in listed)]
    body = bundle(parts)
    return b"".join([_MAGIC, _digest(body), body])


def checkpoint_of(data: bytes) -> Checkpoint:
    """Raises UsageError for what ``written`` does not write."""
    if data[:4] != _MAGIC:
        raise UsageError("not a checkpoint")
    body = data[4 + _DIGEST :]
    if _digest(body) != data[4 : 4 + _DIGEST]:
        raise UsageError("damaged, its digest does not match")
    try:
        head, collector, *states = unbundle(body)
        header = json.loads(head)
        if header["v"] != VERSION:
            raise UsageError(f"version {header['v']}; allowed: {VERSION}, of this testbed")
        keys = [(str(role), int(lane)) for role, lane in header["states"]]
        return Checkpoint(header["step"], dict(zip(keys, states, strict=True)), collector, header["facts"])
    except (ValueError, KeyError, TypeError) as error:
        raise UsageError(f"not a checkpoint: {error}") from None


def record_of(figures: Figures) -> bytes:
    body = _RECORD.pack(figures.after, figures.to, len(figures.content)) + figures.content
    return body + _digest(body)


def records(data: bytes) -> tuple[list[Figures], list[int]]:
    """The records up to the first that is not whole, and where each ends."""
    found: list[Figures] = []
    ends: list[int] = []
    begin = 0
    while begin + _RECORD.size <= len(data):
        after, to, size = _RECORD.unpack_from(data, begin)
        end = begin + _RECORD.size + size
        if end + _DIGEST > len(data) or _digest(data[begin:end]) != data[end : end + _DIGEST]:
            break
        found.append(Figures(after, to, data[begin + _RECORD.size : end]))
        begin = end + _DIGEST
        ends.append(begin)
    return found, ends


def note_line(note: Mapping[str, Any]) -> bytes:
    return json.dumps(note).encode() + b"\n"


def notes(data: bytes) -> tuple[list[dict[str, Any]], int]:
    """The notes up to the first line that is not whole, and where they end."""
    found: list[dict[str, Any]] = []
    end = 0
    for line in data.splitlines(keepends=True):
        try:
            note = json.loads(line)
        except ValueError:
            break
        if not line.endswith(b"\n") or not isinstance(note, dict):
            break
        found.append(note)
        end += len(line)
    return found, end


def _digest(body: bytes) -> bytes:
    return blake2b(body, digest_size=_DIGEST).digest()
