"""What came of a check, and what a check raises."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any, Literal

Status = Literal["passed", "failed", "skipped", "not claimed"]


class Failed(Exception):
    """The estimator does not do what the check wants; the text says what it does, with numbers."""


class Skipped(Exception):
    """The check says nothing of this estimator; the text says why."""


@dataclass(frozen=True)
class Result:
    """One check: its name, what it wants, what came of it, and why, on one line."""

    name: str
    what: str
    status: Status
    text: str


@dataclass(frozen=True)
class Report:
    """All checks of one estimator."""

    estimator: str
    results: tuple[Result, ...]

    @property
    def conforms(self) -> bool:
        return self.count("failed") == 0

    def count(self, status: Status) -> int:
        return sum(result.status == status for result in self.results)

    def as_dict(self) -> dict[str, Any]:
        statuses: tuple[Status, ...] = ("passed", "failed", "skipped", "not claimed")
        counts = {status.replace(" ", "_"): self.count(status) for status in statuses}
        return {
            "estimator": self.estimator,
            "conforms": self.conforms,
            **counts,
            "checks": [asdict(result) for result in self.results],
        }
