"""Run the command line inside the test, with its exit code and what it printed."""

from __future__ import annotations

import signal
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest
import tomli_w

from testbed.cli.main import run_command

TABLES: dict[str, Any] = {
    "name": "small",
    "steps": 12,
    "lanes": 3,
    "seed": 5,
    "system": {
        "A": [[1.1, 0.2], [0.0, 0.7]],
        "B": [[1.0], [-0.5]],
        "C": [[1.0, 0.5]],
        "Q": [[0.5, 0.1], [0.1, 0.3]],
        "R": [[0.4]],
    },
    "input": {"kind": "constant", "value": [1.0]},
    "links": {
        "control": {"loss": {"kind": "bernoulli", "arrival": 0.7}},
        "observation": {"loss": {"kind": "markov", "recovery": 0.7, "failure": 0.2}},
    },
    "estimators": [{"name": "aoe"}, {"name": "kfio", "acks": "perfect"}],
}


@dataclass(frozen=True)
class Outcome:
    code: int
    out: str
    err: str


Command = Callable[..., Outcome]


def write(path: Path, **changes: Any) -> Path:
    """A scenario file; `changes` replace whole tables, None leaves one out."""
    tables = {key: value for key, value in {**TABLES, **changes}.items() if value is not None}
    path.write_text(tomli_w.dumps(tables))
    return path


@pytest.fixture
def testbed(capsys: pytest.CaptureFixture[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Command]:
    """`testbed ARGUMENTS…` in an empty folder that holds the scenario s.toml."""
    monkeypatch.chdir(tmp_path)
    write(tmp_path / "s.toml")
    handlers = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)}

    def run(*arguments: object) -> Outcome:
        capsys.readouterr()
        code = run_command([str(argument) for argument in arguments])
        printed = capsys.readouterr()
        return Outcome(code, printed.out, printed.err)

    yield run
    for number, handler in handlers.items():
        signal.signal(number, handler)
