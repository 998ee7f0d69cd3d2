"""The journal: what was said to be on disk is there whenever the end comes, and nothing that is damaged is taken."""

from __future__ import annotations

import errno
import os
import threading
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any
from unittest.mock import patch

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from orchestrator.parts import Bench, given_scenario
from testbed.errors import RunFailed, UsageError
from testbed.orchestrator.journal import Found, Journal, read

FACTS = {"run": "run0testrun1", "scenario": "name = 'test'", "versions": {"numpy": "2"}}
STATES = {("plant", 0): b"plant", ("plant", 2): b"", ("link.control", 0): bytes(range(256))}


def give(journal: Journal, step: int, *before: Callable[[], None]) -> None:
    """Two notes, and a checkpoint two steps after the last one."""
    for k in (step - 1, step):
        journal.note(step=k, text=f"step {k}")
        journal.figures(k, f"figures of {k}".encode() * k)
    journal.checkpoint(step, STATES, f"collector {step}".encode(), {"done": [step, None, "ä"]}, *before)


def wait(journal: Journal, step: int) -> None:
    """Until a checkpoint is on disk; the test's own time limit ends what does not come."""
    pause = threading.Event()
    while journal.stable < step:
        journal.check()
        pause.wait(0.001)


def made(folder: Path, last: int = 6) -> Path:
    journal = Journal(folder)
    journal.begin(FACTS)
    for step in range(2, last + 1, 2):
        give(journal, step)
        wait(journal, step)
    journal.close()
    return folder


def assert_whole(found: Found, step: int) -> None:
    """What was found is what ``give`` gave, up to some step."""
    assert found.begin == FACTS
    assert found.step == step
    assert [note["step"] for note in found.notes] == list(range(1, len(found.notes) + 1))
    assert len(found.figures) >= step
    for k, part in enumerate(found.figures, start=1):
        assert (part.after, part.to, part.content) == (k - 1, k, f"figures of {k}".encode() * k)
    if found.checkpoint is not None:
        assert dict(found.checkpoint.states) == STATES
        assert found.checkpoint.collector == f"collector {step}".encode()
        assert found.checkpoint.facts == {"done": [step, None, "ä"]}


def test_a_journal_gives_back_what_it_was_given(tmp_path: Path) -> None:
    found = read(made(tmp_path / "journal"))
    assert_whole(found, 6)
    assert (len(found.notes), len(found.figures), found.lost) == (6, 6, ())
    names = {path.name for path in (tmp_path / "journal").iterdir()}
    assert names == {"begin.json", "notes.jsonl", "figures.bin", "checkpoint-4.bin", "checkpoint-6.bin"}


@pytest.mark.parametrize("name", ["notes.jsonl", "figures.bin", "checkpoint-6.bin", "checkpoint-4.bin"])
def test_a_file_that_ends_anywhere_costs_what_is_missing(name: str, tmp_path: Path) -> None:
    folder = made(tmp_path / "journal")
    whole = (folder / name).read_bytes()
    line_ends = [i + 1 for i, byte in enumerate(whole) if byte == ord("\n")]
    record_ends = np.cumsum([24 + len(f"figures of {k}") * k + 16 for k in range(1, 7)]).tolist()
    for size in range(len(whole)):
        os.truncate(folder / name, size)
        found = read(folder)
        notes, figures, step = 6, 6, 6
        if name == "notes.jsonl":
            notes = sum(end <= size for end in line_ends)
        elif name == "figures.bin":
            figures = sum(end <= size for end in record_ends)
            step = next((k for k in (6, 4) if k <= figures), 0)
        elif name == "checkpoint-6.bin":
            step = 4
        assert (len(found.notes), len(found.figures)) == (notes, figures)
        assert_whole(found, step)
        ends = {"notes.jsonl": [0, *line_ends], "figures.bin": [0, *record_ends]}.get(name, [])
        unread = name == "checkpoint-4.bin"  # there is a newer one
        assert bool(found.lost) == (step < 6 or (size not in ends and not unread))
        (folder / name).write_bytes(whole)
    for path in (folder / "checkpoint-6.bin", folder / "checkpoint-4.bin"):
        os.truncate(path, 30)
    assert_whole(read(folder), 0)


def test_a_bit_that_flips_is_noticed(tmp_path: Path) -> None:
    folder = made(tmp_path / "journal")
    rng = np.random.default_rng(1)
    for name, step in (("checkpoint-6.bin", 4), ("figures.bin", None)):
        whole = (folder / name).read_bytes()
        for place in rng.integers(len(whole), size=150):
            damaged = bytearray(whole)
            damaged[place] ^= 1 << int(rng.integers(8))
            (folder / name).write_bytes(damaged)
            found = read(folder)
            assert found.lost
            assert_whole(found, found.step if step is None else step)
        (folder / name).write_bytes(whole)


def crash(folder: Path, call: str, at: int) -> int:
    """Write a journal in a process that dies in the middle of the at-th call; what it said was on disk."""
    heard, say = os.pipe()
    child = os.fork()
    if child == 0:  # pragma: no cover
        try:
            original, tell, count = getattr(os, call), os.write, 0

            def dies(*given: Any) -> Any:
                nonlocal count
                count += 1
                if count == at:
                    if call == "write":
                        original(given[0], bytes(given[1])[: len(given[1]) // 2])
                    os._exit(9)
                return original(*given)

            journal = Journal(folder)
            with patch.object(os, call, dies):
                journal.begin(FACTS)
                for step in (2, 4, 6):
                    give(journal, step)
                    wait(journal, step)
                    tell(say, bytes([step]))
                journal.close()
        finally:
            os._exit(0)
    os.close(say)
    with os.fdopen(heard, "rb") as pipe:
        said = pipe.read()
    os.waitpid(child, 0)
    return max(said, default=0)


@pytest.mark.parametrize("call", ["write", "replace", "fsync", "unlink", "ftruncate"])
def test_whenever_the_writer_dies_what_was_on_disk_is_found(call: str, tmp_path: Path) -> None:
    for at in range(1, 30):
        folder = tmp_path / f"{call}-{at}"
        stable = crash(folder, call, at)
        if not (folder / "begin.json").exists():
            assert stable == 0
            with pytest.raises(UsageError, match="no journal of a run"):
                read(folder)
            continue
        found = read(folder)
        assert found.step >= stable
        assert_whole(found, found.step)
        again = Journal(folder)
        again.go_on(found.step)
        give(again, found.step + 2)
        again.close()
        later = read(folder)
        assert (later.step, later.lost) == (found.step + 2, ())
        assert later.figures[: found.step] == found.figures[: found.step]
        assert not list(folder.glob("*.partial"))
        if stable == 6:
            return
    pytest.fail("the writer never lived to the end")


def test_a_checkpoint_counts_when_all_it_needs_is_on_disk(tmp_path: Path) -> None:
    """A power cut takes what was not synced: the order of the system's calls."""
    calls: list[tuple[str, str]] = []
    journal = Journal(tmp_path / "journal")

    def name_of(file: int) -> str:
        return Path(os.readlink(f"/proc/self/fd/{file}")).name

    fsync, write, replace = os.fsync, os.write, os.replace

    def seen_fsync(file: int) -> None:
        fsync(file)
        calls.append(("fsync", name_of(file)))

    def seen_write(file: int, data: Any) -> int:
        calls.append(("write", name_of(file)))
        return write(file, data)

    def seen_replace(source: Path, path: Path) -> None:
        calls.append(("replace", Path(path).name))
        replace(source, path)

    with patch.multiple(os, fsync=seen_fsync, write=seen_write, replace=seen_replace):
        journal.begin(FACTS)
        give(journal, 2, lambda: calls.append(("before", "recording")))
        wait(journal, 2)
        calls.append(("stable", ""))
        journal.close()
    last = {call: place for place, call in enumerate(calls[: calls.index(("stable", ""))])}
    renamed = last["replace", "checkpoint-2.bin"]
    for name in ("notes.jsonl", "figures.bin", "checkpoint-2.bin.partial"):
        assert last["write", name] < last["fsync", name] < renamed
    assert last["before", "recording"] < renamed < last["fsync", "journal"]


@pytest.mark.parametrize("call", ["write", "fsync", "replace"])
def test_a_full_disk_is_told_and_nothing_is_lost_silently(call: str, tmp_path: Path) -> None:
    journal = Journal(tmp_path / "journal")
    journal.begin(FACTS)
    give(journal, 2)
    wait(journal, 2)

    def go_on() -> None:
        give(journal, 4)
        wait(journal, 4)

    full = OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
    with (
        patch.object(os, call, side_effect=full),
        pytest.raises(RunFailed, match=r"journal .*: no space left on device"),
    ):
        go_on()
    for again in (partial(journal.note, step=5), partial(journal.figures, 5, b""), journal.check, journal.close):
        with pytest.raises(RunFailed, match="no space left"):
            again()
    found = read(tmp_path / "journal")
    assert_whole(found, 2)


def test_what_must_be_on_disk_before_may_fail_too(tmp_path: Path) -> None:
    def full() -> None:
        raise OSError(errno.EIO, os.strerror(errno.EIO))

    journal = Journal(tmp_path / "journal")
    journal.begin(FACTS)
    give(journal, 2, full)
    with pytest.raises(RunFailed, match="input/output error"):
        journal.close()
    assert_whole(read(tmp_path / "journal"), 0)


def test_the_newest_waits_while_the_disk_is_busy(tmp_path: Path) -> None:
    begun, free = threading.Event(), threading.Event()
    journal = Journal(tmp_path / "journal")
    journal.begin(FACTS)
    give(journal, 2, begun.set, partial(_waited, free))
    begun.wait()
    for step in (4, 6, 8):
        give(journal, step)
    assert (journal.stable, journal.skipped) == (0, 2)
    free.set()
    journal.close()
    assert (journal.stable, journal.skipped) == (8, 2)
    assert_whole(read(tmp_path / "journal"), 8)


def _waited(event: threading.Event) -> None:
    event.wait()


def test_one_process_writes_a_journal(tmp_path: Path) -> None:
    first = Journal(tmp_path / "journal")
    first.begin(FACTS)
    second = Journal(tmp_path / "journal")
    for again in (partial(second.begin, FACTS), partial(second.go_on, 0)):
        with pytest.raises(UsageError, match="is the run still going"):
            again()
    first.close()
    made(tmp_path / "journal", 2)
    assert_whole(read(tmp_path / "journal"), 2)


def test_a_checkpoint_needs_its_figures(tmp_path: Path) -> None:
    journal = Journal(tmp_path / "journal")
    journal.begin(FACTS)
    journal.figures(3, b"")
    with pytest.raises(ValueError, match="step 4, and no figures end there"):
        journal.checkpoint(4, {}, b"", {})
    journal.close()
    (tmp_path / "journal" / "figures.bin").write_bytes(b"")
    with pytest.raises(UsageError, match="no figures up to step 3"):
        Journal(tmp_path / "journal").go_on(3)


def test_no_journal_is_said_in_one_line(tmp_path: Path) -> None:
    with pytest.raises(UsageError, match="no journal of a run"):
        read(tmp_path)
    (tmp_path / "begin.json").write_text("[")
    with pytest.raises(UsageError, match=r"begin\.json: damaged"):
        read(tmp_path)


@settings(deadline=None, max_examples=20)
@given(data=st.data())
def test_a_collector_goes_on_from_the_journal(data: st.DataObject, tmp_path_factory: pytest.TempPathFactory) -> None:
    """Whatever had come when the end came."""
    folder = tmp_path_factory.mktemp("run") / "journal"
    whole, first, second = (Bench(given_scenario()) for _ in range(3))
    order = data.draw(st.permutations(first.parts()))
    every = data.draw(st.integers(1, 3))
    journal = Journal(folder)
    journal.begin(FACTS)

    def on_completed(step: int) -> None:
        journal.figures(step, first.collector.figures(journal.figures_to, step))
        if step % every == 0:
            journal.checkpoint(step, {}, first.collector.state(), {})

    first.collector.on_completed = on_completed
    for part in order[: data.draw(st.integers(0, len(order)))]:
        first.give(part)
    journal.close()
    found = read(folder)
    assert found.step == first.collector.completed // every * every
    if found.checkpoint is not None:
        parts = [part.content for part in found.figures]
        second.collector.resume(found.step, found.checkpoint.collector, parts)
    for part in order:
        whole.give(part)
        if part[1] > found.step:
            second.give(part)
    one, other = whole.collector, second.collector
    assert [s.mean for s in one.estimators.values()] == [s.mean for s in other.estimators.values()]
    assert one.largest_state == other.largest_state
    assert [a.tobytes() for a in one.by_lane().all] == [a.tobytes() for a in other.by_lane().all]
