"""Reading a recording back: the packets of one lane as lines of PACKETS.jsonl."""

from __future__ import annotations

import json
import os
import struct
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, BinaryIO

from mcap.exceptions import McapError
from mcap.reader import make_reader
from mcap.records import Channel, McapRecord, Metadata, Schema
from mcap.records import Message as StoredMessage
from mcap.stream_reader import StreamReader
from mcap.writer import MCAP0_MAGIC
from numpy.typing import NDArray

from testbed.errors import UsageError
from testbed.scenario import parse_scenario
from testbed.wire.codec import Decoder, Rejected
from testbed.wire.messages import MESSAGES, Message, Packet
from testbed.wire.setup import Setup

_Arrays = dict[str, NDArray[Any]]


def read_recording(path: Path, say: Callable[[str], None] | None = None) -> Iterator[tuple[str, Packet, _Arrays]]:
    """(topic, header, arrays) of every message, in the order of virtual time.

    say: told, in one line, of a recording whose run was cut off, of which what is whole is read; None: such a one is
    refused. Raises UsageError where the file is not a recording, OSError where it cannot be read.
    """
    with path.open("rb") as file, _refused(path):
        finished = _finished(file)
        scenario = _scenario(file, path, finished=finished)
        messages = make_reader(file, validate_crcs=True).iter_messages() if finished else _of_unfinished(file)
        if not finished:
            found = sorted(messages, key=lambda entry: entry[2].log_time)
            last = found[-1][2].log_time // parse_scenario(scenario).clock.period_ns if found else 0
            told = f"its run was cut off; {len(found)} messages are whole, up to step {last}"
            if say is None:
                raise UsageError(f"{path}: not a whole recording: {told}")
            say(f"{path}: {told}")
            messages = iter(found)
        decoders: dict[str, Decoder[Message]] = {}
        for schema, channel, message in messages:
            kind = schema.name if schema is not None else ""
            if kind not in decoders:
                run = json.loads(message.data[8 : 8 + int.from_bytes(message.data[4:8], "little")])["run"]
                sizes = Setup(run, parse_scenario(scenario, source=f"{path}: scenario")).sizes
                decoders[kind] = Decoder(MESSAGES[kind], run, sizes)
            header, arrays = decoders[kind].decode(message.data)
            if not isinstance(header, Packet):
                raise Rejected("schema", f"a {kind} in a recording")
            yield channel.topic, header, arrays


def stored_messages(path: Path) -> Iterator[tuple[str, str, StoredMessage]]:
    """(topic, type, message) of what is whole in a recording, finished or not, in the order of the file.

    Raises UsageError where it is not the recording of a run, or cannot be read.
    """
    try:
        with path.open("rb") as file, _refused(path):
            _scenario(file, path, finished=False)
            for schema, channel, message in _of_unfinished(file):
                if schema is None or schema.name not in MESSAGES:
                    raise UsageError(f"{path}: not the recording of a run")
                yield channel.topic, schema.name, message
    except FileNotFoundError:
        raise UsageError(f"{path}: no such file: the recording cannot go on") from None


@contextmanager
def _refused(path: Path) -> Iterator[None]:
    try:
        yield
    except UsageError:
        raise
    except (McapError, Rejected, struct.error, OSError, KeyError, TypeError, ValueError) as error:
        raise UsageError(f"{path}: not a whole recording: {' '.join(str(error).split())}") from None


def _finished(file: BinaryIO) -> bool:
    """Whether the writer came to the end: a file that is not in MCAP at all counts as finished."""
    begin = file.read(len(MCAP0_MAGIC))
    size = file.seek(0, os.SEEK_END)
    file.seek(max(0, size - len(MCAP0_MAGIC)))
    end = file.read()
    file.seek(0)
    return begin != MCAP0_MAGIC or (size > len(MCAP0_MAGIC) and end == MCAP0_MAGIC)


def _scenario(file: BinaryIO, path: Path, *, finished: bool) -> str:
    """What the run was; the file is at its beginning afterwards."""
    records = make_reader(file).iter_metadata() if finished else _records(file)
    found = next((m.metadata["scenario"] for m in records if isinstance(m, Metadata) and m.name == "run"), None)
    file.seek(0)
    if found is None:
        raise UsageError(f"{path}: not the recording of a run")
    return found


def _of_unfinished(file: BinaryIO) -> Iterator[tuple[Schema | None, Channel, StoredMessage]]:
    """The messages of all chunks that are whole, in the order of the file."""
    schemas: dict[int, Schema] = {}
    channels: dict[int, Channel] = {}
    for record in _records(file):
        if isinstance(record, Schema):
            schemas[record.id] = record
        elif isinstance(record, Channel):
            channels[record.id] = record
        elif isinstance(record, StoredMessage):
            channel = channels[record.channel_id]
            yield schemas.get(channel.schema_id), channel, record


def _records(file: BinaryIO) -> Iterator[McapRecord]:
    """Up to the first that is not whole."""
    try:
        yield from StreamReader(file, validate_crcs=True).records
    except (McapError, struct.error, ValueError, OverflowError):
        return


def packets_of_recording(
    path: Path, lane: int, *, perfect_acks: bool, say: Callable[[str], None] | None = None
) -> list[str]:
    """What one lane's estimators received, as lines of PACKETS.jsonl.

    ACKs are those that arrived over the ack link; ``perfect_acks``: those the plant sent. say: as in
    ``read_recording``; the last step is the last of which nothing lacks.
    """
    steps: dict[int, dict[str, Any]] = {}
    noisy = False  # whether noise was received in place of what was lost
    lasts: dict[str, int] = {}  # the last step of each topic
    acks_topic = "ack/sent" if perfect_acks else "ack/delivered"
    for topic, packet, arrays in read_recording(path, say):
        row = lane - packet.lane
        if not 0 <= row < packet.lanes:
            continue
        if topic in ("control/sent", "observation/delivered", acks_topic):
            lasts[topic] = max(lasts.get(topic, 0), packet.step + (topic == "control/sent"))
        if topic == "control/sent":
            steps.setdefault(packet.step + 1, {})["u"] = arrays["u"][row].tolist()
        elif topic == "observation/delivered":
            parts = steps.setdefault(packet.step, {})
            parts["y"], parts["gamma"] = arrays["y"][row].tolist() if "y" in arrays else None, int(arrays["mask"][row])
            parts["late"] = [[of, arrays["late_y"][row, i].tolist()] for i, of in _late(arrays, row)]
        elif topic == "observation/sent":
            noisy = noisy or "noise" in arrays
        elif topic == acks_topic:
            acks = [[of - 1, int(arrays["late_nu"][row, i])] for i, of in _late(arrays, row)]
            if "nu" in arrays and ("mask" not in arrays or arrays["mask"][row]):
                acks.append([packet.step - 1, int(arrays["nu"][row])])
            steps.setdefault(packet.step, {})["acks"] = acks
    if not steps:
        raise UsageError(f"{path}: lane {lane} was not recorded; see `record` in the scenario")
    whole = [k for k, parts in steps.items() if "u" in parts and "y" in parts and k <= min(lasts.values())]
    if not whole:
        raise UsageError(f"{path}: holds no whole step of lane {lane}")
    return [json.dumps({"k": k, **_line(steps[k], noisy=noisy)}) for k in sorted(whole)]


def _late(arrays: _Arrays, row: int) -> list[tuple[int, int]]:
    """(place, step) of what arrived late in a lane."""
    if "late_step" not in arrays:
        return []
    return [(i, int(of)) for i, of in enumerate(arrays["late_step"][row]) if arrays["late_mask"][row, i]]


def _line(parts: dict[str, Any], *, noisy: bool) -> dict[str, Any]:
    """What a line says besides k: γ only where a y that was received is noise."""
    arrived = bool(parts["gamma"])
    line = {"u": parts["u"], "y": parts["y"] if arrived or noisy else None, "acks": parts.get("acks", [])}
    if parts.get("late"):
        line["late"] = parts["late"]
    return line if arrived or not noisy else {**line, "gamma": 0}
