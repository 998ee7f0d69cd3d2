"""Runs in process of which somebody asks something, at the moment at which so many steps are complete."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

from orchestrator.runs import run, scenario
from testbed.orchestrator.asked import answer
from testbed.orchestrator.conductor import Conductor
from testbed.orchestrator.summary import Summary


class Commanding(Conductor):
    asked: dict[int, dict[str, Any]]
    answers: list[dict[str, Any]]

    def _collected(self, *arguments: Any) -> None:
        super()._collected(*arguments)
        question = self.asked.pop(self.collector.completed, None)
        if question is not None:
            self.answers.append(json.loads(answer(self, json.dumps(question).encode())))


def commanded(
    folder: Path, monkeypatch: pytest.MonkeyPatch, asked: dict[int, dict[str, Any]], **changes: Any
) -> tuple[Summary, list[dict[str, Any]]]:
    """The run, with at most two steps in flight, and the answers; ``asked``: by completed steps."""
    Commanding.asked, Commanding.answers = dict(asked), []
    monkeypatch.setattr("testbed.orchestrator.run.Conductor", Commanding)
    specs = [{"name": "aoe", "acks": "none"}, {"name": "ff", "acks": "none"}]
    return run(scenario(**{"estimators": specs, "clock": {"window": 2}, **changes}), folder), Commanding.answers
