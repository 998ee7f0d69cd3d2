"""Reading a recording back: the packets of one lane as lines of PACKETS.jsonl."""

from __future__ import annotations

import json
import struct
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from mcap.exceptions import McapError
from mcap.reader import make_reader
from numpy.typing import NDArray

from testbed.errors import UsageError
from testbed.scenario import parse_scenario
from testbed.wire.codec import Decoder, Rejected
from testbed.wire.messages import MESSAGES, Message, Packet
from testbed.wire.setup import Setup

_Arrays = dict[str, NDArray[Any]]


def read_recording(path: Path) -> Iterator[tuple[str, Packet, _Arrays]]:
    """(topic, header, arrays) of every message, in the order of virtual time.

    Raises UsageError where the file is not a recording, OSError where it cannot be read.
    """
    with path.open("rb") as file:
        try:
            reader = make_reader(file, validate_crcs=True)
            scenario = next((m.metadata["scenario"] for m in reader.iter_metadata() if m.name == "run"), None)
            if scenario is None:
                raise UsageError(f"{path}: not the recording of a run")
            decoders: dict[str, Decoder[Message]] = {}
            for schema, channel, message in reader.iter_messages():
                kind = schema.name if schema is not None else ""
                if kind not in decoders:
                    run = json.loads(message.data[8 : 8 + int.from_bytes(message.data[4:8], "little")])["run"]
                    sizes = Setup(run, parse_scenario(scenario, source=f"{path}: scenario")).sizes
                    decoders[kind] = Decoder(MESSAGES[kind], run, sizes)
                header, arrays = decoders[kind].decode(message.data)
                if not isinstance(header, Packet):
                    raise Rejected("schema", f"a {kind} in a recording")
                yield channel.topic, header, arrays
        except (McapError, Rejected, struct.error, OSError, KeyError, TypeError, ValueError) as error:
            raise UsageError(f"{path}: not a whole recording: {' '.join(str(error).split())}") from None


def packets_of_recording(path: Path, lane: int, *, perfect_acks: bool) -> list[str]:
    """What one lane's estimators received, as lines of PACKETS.jsonl.

    ACKs are those that arrived over the ack link; ``perfect_acks``: those the plant sent.
    """
    steps: dict[int, dict[str, Any]] = {}
    noisy = False  # whether noise was received in place of what was lost
    acks_topic = "ack/sent" if perfect_acks else "ack/delivered"
    for topic, packet, arrays in read_recording(path):
        row = lane - packet.lane
        if not 0 <= row < packet.lanes:
            continue
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
    whole = [k for k, parts in steps.items() if "u" in parts and "y" in parts]
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
