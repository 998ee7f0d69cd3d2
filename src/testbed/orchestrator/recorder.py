"""The recording: every packet and estimate of the recorded lanes, as an MCAP file.

Topics are the keys without the run; messages are payloads as they were on the bus, in the format that ``testbed schema
messages`` describes; log time is virtual time in nanoseconds, and so is publish time, which in real time is the date.

What is written is with the operating system after a second or a chunk (1 MiB), whichever comes first, so that a file
whose writer was killed lacks no more than that.
"""

from __future__ import annotations

import json
import os
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from mcap.writer import CompressionType, Writer
from numpy.typing import NDArray

from testbed.errors import RunFailed, UsageError
from testbed.orchestrator.recording import stored_messages
from testbed.wire.codec import encode, entries_of
from testbed.wire.messages import MESSAGES, Packet, messages_json_schema

ENCODING = "ncs1"


FLUSH_S = 1.0


class Recorder:
    """Appends packets to ``path``; the first ``lanes`` lanes of each.

    Every method raises RunFailed, in one line, where the disk refuses.
    """

    def __init__(
        self,
        path: Path,
        *,
        lanes: int,
        period_ns: int,
        metadata: dict[str, str],
        resumed: int | None = None,
        clock_s: Callable[[], float] = time.monotonic,
    ) -> None:
        """resumed: go on with the recording that is there after so many steps: the packets of these are kept.

        Raises UsageError where there is no recording that could be read.
        """
        self._path, self._clock_s, self._flushed_s = path, clock_s, clock_s()
        self._lanes, self._period_ns = lanes, period_ns
        self._schemas: dict[str, int] = {}
        self._channels: dict[str, int] = {}
        self._definitions = messages_json_schema()["$defs"]
        self._last: dict[tuple[str, int], int] = {}
        self._failed = False
        self.messages = 0
        with self._refusals():
            if resumed is None:
                self._open(path, metadata)
            else:
                self._rewrite(path, metadata, resumed)

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
        try:
            self._writer.add_message(
                self._channel(topic, packet.type), time_ns, payload, date_ns or time_ns, packet.seq % 2**32
            )
        except OSError as error:
            raise self._refused(error) from None
        self._last[topic, packet.lane] = packet.step
        self.messages += 1
        if self._clock_s() - self._flushed_s >= FLUSH_S:
            self.flush()

    def holds(self, step: int, topic: str, lane: int) -> bool:
        """Whether the first ``step`` packets are in of a block of lanes, which begins at ``lane``."""
        first = 0 if topic.startswith("control/") else 1
        return lane >= self._lanes or self._last.get((topic, lane), first - 1) - first + 1 >= step

    def flush(self) -> None:
        """Hand everything to the operating system: it outlives this process."""
        self._flushed_s = self._clock_s()
        with self._refusals():
            self._writer.flush()  # type: ignore[no-untyped-call]

    def fsync(self) -> None:
        """Have on disk what was flushed: it outlives a power cut. From any thread; raises OSError."""
        os.fsync(self._file.fileno())

    def sync(self) -> None:
        """Have everything on disk."""
        self.flush()
        with self._refusals():
            self.fsync()

    def close(self) -> None:
        """Write the index and close the file; after a refusal just close it."""
        if self._file.closed:
            return
        try:
            if not self._failed:
                with self._refusals():
                    self._writer.finish()  # type: ignore[no-untyped-call]
                    self._file.flush()
        finally:
            self._close()

    def _open(self, path: Path, metadata: dict[str, str]) -> None:
        self._file = path.open("wb")
        self._writer = Writer(self._file, compression=CompressionType.NONE)
        self._writer.start(profile="", library="ncs-testbed")
        self._writer.add_metadata("run", metadata)
        self._file.flush()

    def _rewrite(self, path: Path, metadata: dict[str, str], done: int) -> None:
        """A new file with what is kept takes the place of the old one."""
        kept = stored_messages(path)
        partial = path.with_name(f"{path.name}.partial")
        self._open(partial, metadata)
        try:
            for topic, kind, message in kept:
                model = MESSAGES[kind]
                assert issubclass(model, Packet)
                step = message.log_time // self._period_ns
                if step - model.FIRST_STEP < done:
                    channel = self._channel(topic, kind)
                    self._writer.add_message(
                        channel, message.log_time, message.data, message.publish_time, message.sequence
                    )
                    lane = _lane_of(message.data)
                    self._last[topic, lane] = max(step, self._last.get((topic, lane), 0))
                    self.messages += 1
            self._writer.flush()  # type: ignore[no-untyped-call]
            self.fsync()
            os.replace(partial, path)
        except (OSError, UsageError):
            self._close()
            partial.unlink(missing_ok=True)
            raise

    def _close(self) -> None:
        try:
            self._file.close()
        except OSError:  # what is in its buffer; told before
            self._failed = True

    @contextmanager
    def _refusals(self) -> Iterator[None]:
        try:
            yield
        except OSError as error:
            raise self._refused(error) from None

    def _refused(self, error: OSError) -> RunFailed:
        self._failed = True
        return RunFailed(f"cannot write the recording {self._path}: {(error.strerror or str(error)).lower()}")

    def _channel(self, topic: str, kind: str) -> int:
        if topic not in self._channels:
            if kind not in self._schemas:
                schema = json.dumps(self._definitions[kind]).encode()
                self._schemas[kind] = self._writer.register_schema(kind, "jsonschema", schema)
            self._channels[topic] = self._writer.register_channel(topic, ENCODING, self._schemas[kind])
        return self._channels[topic]


def _lane_of(payload: bytes) -> int:
    header = json.loads(payload[8 : 8 + int.from_bytes(payload[4:8], "little")])
    return int(header["lane"])
