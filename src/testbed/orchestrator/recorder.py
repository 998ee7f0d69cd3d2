"""The recording: every packet and estimate of the recorded lanes, as an MCAP file.

Topics are the keys without the run; messages are payloads as they were on the bus, in the format that ``testbed schema
messages`` describes; log time is virtual time in nanoseconds, and so is publish time, which in real time is the date.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from mcap.writer import CompressionType, Writer
from numpy.typing import NDArray

from testbed.wire.codec import encode, entries_of
from testbed.wire.messages import Packet, messages_json_schema

ENCODING = "ncs1"


class Recorder:
    """Appends packets to ``path``; the first ``lanes`` lanes of each."""

    def __init__(self, path: Path, *, lanes: int, period_ns: int, metadata: dict[str, str]) -> None:
        self._file = path.open("wb")
        self._writer = Writer(self._file, compression=CompressionType.NONE)
        self._writer.start(profile="", library="ncs-testbed")
        self._writer.add_metadata("run", metadata)
        self._lanes, self._period_ns = lanes, period_ns
        self._schemas: dict[str, int] = {}
        self._channels: dict[str, int] = {}
        self._definitions = messages_json_schema()["$defs"]
        self.messages = 0

    def write(
        self, topic: str, packet: Packet, arrays: dict[str, NDArray[Any]], payload: bytes, date_ns: int = 0
    ) -> None:
        """Record one packet, cut to the recorded lanes.

        payload: the message as it came. date_ns: when it was published; 0 in virtual time.
        """
        if packet.lane >= self._lanes:
            return
        kept = min(packet.lanes, self._lanes - packet.lane)
        if kept < packet.lanes:
            arrays = {name: array[:kept] for name, array in arrays.items()}
            packet = packet.model_copy(update={"lanes": kept, "arrays": entries_of(arrays)})
            payload = encode(packet, arrays)
        time_ns = packet.step * self._period_ns
        self._writer.add_message(
            self._channel(topic, packet.type), time_ns, payload, date_ns or time_ns, packet.seq % 2**32
        )
        self.messages += 1

    def close(self) -> None:
        """Write the index and close the file."""
        if not self._file.closed:
            self._writer.finish()  # type: ignore[no-untyped-call]
            self._file.close()

    def _channel(self, topic: str, kind: str) -> int:
        if topic not in self._channels:
            if kind not in self._schemas:
                schema = json.dumps(self._definitions[kind]).encode()
                self._schemas[kind] = self._writer.register_schema(kind, "jsonschema", schema)
            self._channels[topic] = self._writer.register_channel(topic, ENCODING, self._schemas[kind])
        return self._channels[topic]
