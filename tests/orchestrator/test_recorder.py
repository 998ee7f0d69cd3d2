"""The recorder: what a killed run leaves can be read, and goes on to what it would have been."""

from __future__ import annotations

import json
import os
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from orchestrator.runs import recorded, run, scenario
from testbed.errors import RunFailed, UsageError
from testbed.orchestrator.recorder import Recorder
from testbed.orchestrator.recording import packets_of_recording, read_recording, stored_messages
from testbed.scenario import Scenario, to_toml
from testbed.wire.messages import Packet

Messages = list[tuple[str, Packet, dict[str, NDArray[Any]], bytes]]
STEPS, LANES = 12, 5


@pytest.fixture(scope="module")
def given() -> Scenario:
    return scenario(steps=STEPS, lanes=LANES, transport={"lanes_per_packet": 2})


@pytest.fixture(scope="module")
def original(given: Scenario, tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("run")
    run(given, out)
    return out / "recording.mcap"


def in_order(path: Path) -> Messages:
    """As they came: in the order of the file."""
    payloads: dict[str, list[bytes]] = {}
    for topic, _, message in stored_messages(path):
        payloads.setdefault(topic, []).append(bytes(message.data))
    given = {(topic, p.step, p.lane): (topic, p, arrays) for topic, p, arrays in read_recording(path)}
    order = [(topic, *step_and_lane(message.data)) for topic, _, message in stored_messages(path)]
    turns = {topic: iter(of) for topic, of in payloads.items()}
    return [(*given[key], next(turns[key[0]])) for key in order]


def step_and_lane(payload: bytes) -> tuple[int, int]:
    header = json.loads(payload[8 : 8 + int.from_bytes(payload[4:8], "little")])
    return header["step"], header["lane"]


def content(path: Path) -> set[tuple[Any, ...]]:
    found = [(topic, kind, m.log_time, m.publish_time, m.sequence, m.data) for topic, kind, m in stored_messages(path)]
    assert len(set(found)) == len(found)
    return set(found)


def recorder(path: Path, given: Scenario, **changes: Any) -> Recorder:
    own = {"lanes": LANES, "period_ns": given.clock.period_ns, "metadata": {"scenario": to_toml(given)}}
    return Recorder(path, **{**own, **changes})


def done(packet: Packet) -> int:
    """Which packet of its block on its key this is, from 1 on."""
    return packet.step - packet.FIRST_STEP + 1


def clock(step_s: float) -> Iterator[float]:
    now = 0.0
    while True:
        yield now
        now += step_s


def test_what_was_written_is_in_the_file_after_a_second(given: Scenario, original: Path, tmp_path: Path) -> None:
    messages, path = in_order(original), tmp_path / "recording.mcap"
    times = clock(0.25)  # passes at each look, and each flush looks once more
    writing = recorder(path, given, clock_s=lambda: next(times))
    for count, (topic, packet, arrays, payload) in enumerate(messages, start=1):
        writing.write(topic, packet, arrays, payload)
        there = sum(1 for _ in stored_messages(path))
        assert count - 4 < there <= count
    writing.close()
    assert content(path) == content(original)


def test_a_recording_that_ends_anywhere_is_read_up_to_there(given: Scenario, original: Path, tmp_path: Path) -> None:
    messages, path = in_order(original), tmp_path / "recording.mcap"
    writing = recorder(path, given)
    counts, sizes = [0], [path.stat().st_size]
    for count, (topic, packet, arrays, payload) in enumerate(messages, start=1):
        writing.write(topic, packet, arrays, payload)
        if count % 7 == 0:
            writing.flush()
            counts.append(count)
            sizes.append(path.stat().st_size)
    writing.close()
    whole = path.read_bytes()
    payloads = [payload for *_, payload in messages]
    counts.append(len(messages))
    rng = np.random.default_rng(1)
    cut = tmp_path / "cut.mcap"
    for size in sorted({*rng.integers(0, len(whole), size=150).tolist(), *sizes[-3:], len(whole) - 1}):
        cut.write_bytes(whole[:size])
        before = sum(end <= size for end in sizes[1:])
        try:
            found = [message.data for _, _, message in stored_messages(cut)]
        except UsageError:
            assert before == 0
            continue
        assert len(found) in counts[before : before + 2]
        assert found == payloads[: len(found)]
        said: list[str] = []
        read = [(topic, packet.step, packet.lane) for topic, packet, _ in read_recording(cut, said.append)]
        assert sorted(read) == sorted((topic, packet.step, packet.lane) for topic, packet, *_ in messages[: len(found)])
        last = max((packet.step for _, packet, *_ in messages[: len(found)]), default=0)
        assert said == [f"{cut}: its run was cut off; {len(found)} messages are whole, up to step {last}"]
        with pytest.raises(UsageError, match="not a whole recording: its run was cut off"):
            next(read_recording(cut))


def test_what_is_damaged_in_the_middle_ends_there(given: Scenario, original: Path, tmp_path: Path) -> None:
    """As where a power cut left a hole: nothing behind it is taken for whole."""
    path = tmp_path / "recording.mcap"
    writing = recorder(path, given)
    messages, sizes = in_order(original), []
    for count, (topic, packet, arrays, payload) in enumerate(messages, start=1):
        writing.write(topic, packet, arrays, payload)
        if count % 20 == 0:
            writing.flush()
            sizes.append(path.stat().st_size)
    data = bytearray(path.read_bytes()[: sizes[-1]])
    writing.close()
    data[sizes[0] + 400 : sizes[0] + 1400] = bytes(1000)
    assert sizes[0] + 1400 < sizes[1]
    path.write_bytes(data)
    found = [message.data for _, _, message in stored_messages(path)]
    assert found == [payload for *_, payload in messages[:20]]


@pytest.mark.parametrize("step", [0, 1, 5, 11, 12])
@pytest.mark.parametrize("lanes", [LANES, 1])
def test_a_recording_goes_on_to_what_it_would_have_been(
    lanes: int, step: int, given: Scenario, original: Path, tmp_path: Path
) -> None:
    messages = in_order(original)
    paths = {name: tmp_path / f"{name}.mcap" for name in ("whole", "cut")}
    for name, path in paths.items():
        writing = recorder(path, given, lanes=lanes)
        for topic, packet, arrays, payload in messages:
            if name == "whole" or done(packet) <= step + 2:  # what was in flight is there too
                writing.write(topic, packet, arrays, payload)
        writing.sync()
        if name == "whole":
            writing.close()
    again = recorder(paths["cut"], given, lanes=lanes, resumed=step)
    topics = {
        (topic, packet.lane): max(done(p) for t, p, *_ in messages if t == topic) for topic, packet, *_ in messages
    }
    for (topic, lane), last in topics.items():
        assert again.holds(min(step, last), topic, lane)
        assert again.holds(step + 1, topic, lane) == (lane >= lanes)
    assert not (tmp_path / "cut.mcap.partial").exists()
    for topic, packet, arrays, payload in messages:
        if done(packet) > step:
            again.write(topic, packet, arrays, payload)
    again.close()
    assert content(paths["cut"]) == content(paths["whole"])
    assert again.messages == len(content(paths["whole"]))
    assert [p.step for _, p, _ in read_recording(paths["cut"])]


def test_a_recording_that_is_not_there_cannot_go_on(given: Scenario, tmp_path: Path) -> None:
    path = tmp_path / "recording.mcap"
    with pytest.raises(UsageError, match="no such file"):
        recorder(path, given, resumed=3)
    path.write_bytes(b"something else")
    with pytest.raises(UsageError, match="not the recording of a run"):
        recorder(path, given, resumed=3)
    assert path.read_bytes() == b"something else"
    assert [p.name for p in tmp_path.iterdir()] == ["recording.mcap"]


@pytest.mark.skipif(not os.path.exists("/dev/full"), reason="needs /dev/full")
def test_a_full_disk_is_told_in_one_line(given: Scenario, original: Path, tmp_path: Path) -> None:
    text = r"cannot write the recording .*: no space left on device$"
    with pytest.raises(RunFailed, match=text):
        recorder(Path("/dev/full"), given)
    writing = recorder(tmp_path / "recording.mcap", given)
    topic, packet, arrays, payload = in_order(original)[0]
    writing.write(topic, packet, arrays, payload)
    full = os.open("/dev/full", os.O_WRONLY)
    os.dup2(full, writing._file.fileno())
    os.close(full)
    with pytest.raises(RunFailed, match=text):
        writing.flush()
    writing.close()


def test_a_replay_of_what_is_whole_has_whole_steps(given: Scenario, original: Path, tmp_path: Path) -> None:
    expected = packets_of_recording(original, 0, perfect_acks=False)
    cut, said = tmp_path / "cut.mcap", list[str]()
    writing = recorder(cut, given)
    for topic, packet, arrays, payload in in_order(original):
        if packet.step <= 7 and (topic, packet.step) != ("ack/delivered", 7):
            writing.write(topic, packet, arrays, payload)
    writing.sync()
    assert packets_of_recording(cut, 0, perfect_acks=False, say=said.append) == expected[:6]
    assert len(said) == 1
    writing.close()
    assert recorded(original.parent, LANES, STEPS).keys()
