"""What a run published and recorded, seen from inside the test."""

from __future__ import annotations

from collections import Counter
from contextlib import AbstractContextManager, ExitStack
from functools import cache
from pathlib import Path
from typing import Any
from unittest.mock import patch

from numpy.typing import NDArray

from testbed.orchestrator import outcome, recorder
from testbed.orchestrator.collect import Collector
from testbed.wire.messages import Packet

Arrays = dict[str, NDArray[Any]]
_schemas, _versions = cache(recorder.messages_json_schema), cache(outcome.versions)


class Observed:
    """recorded: the bytes of each packet that went into the recording, by topic, step and lane, and how often it did.
    estimates: how often the collector took an estimate, by name, step and lane.
    """

    def __init__(self) -> None:
        self.recorded: dict[tuple[str, int, int], bytes] = {}
        self.times: Counter[tuple[str, int, int]] = Counter()
        self.estimates: Counter[tuple[str, int, int]] = Counter()

    def watching(self) -> AbstractContextManager[object]:
        """While a run goes; what is the same for all runs is made once."""
        stack = ExitStack()
        write, estimate = recorder.Recorder.write, Collector.estimate

        def note(one: recorder.Recorder, topic: str, packet: Packet, arrays: Arrays, *rest: Any) -> None:
            key = topic, packet.step, packet.lane
            self.times[key] += 1
            self.recorded[key] = b"".join(name.encode() + array.tobytes() for name, array in sorted(arrays.items()))
            write(one, topic, packet, arrays, *rest)

        def count(one: Collector, name: str, step: int, lane: int, arrays: Arrays) -> None:
            self.estimates[name, step, lane] += 1
            estimate(one, name, step, lane, arrays)

        stack.enter_context(patch.object(recorder.Recorder, "write", note))
        stack.enter_context(patch.object(Collector, "estimate", count))
        stack.enter_context(patch.object(recorder, "messages_json_schema", _schemas))
        stack.enter_context(patch.object(outcome, "versions", _versions))
        stack.enter_context(patch("testbed.orchestrator.services.START_S", 0.0))
        stack.enter_context(patch("testbed.orchestrator.run.secrets.token_hex", lambda _: "00000000"))
        return stack


def files_of(folder: Path) -> dict[str, bytes]:
    """Of a run's folder, those whose bytes scenario and seed determine."""
    return {name: (folder / name).read_bytes() for name in ("lanes.npz",) if (folder / name).exists()}
