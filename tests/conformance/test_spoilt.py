"""Every check catches what it is for, and lets a sound estimator of another make through."""

from __future__ import annotations

from typing import Any, ClassVar

import pytest

from conformance.plain import SPOILT, Sound
from testbed.conformance.kit import CHECKS, CLAIMS, examine
from testbed.conformance.result import Report
from testbed.conformance.subject import Subject
from testbed.errors import UsageError
from testbed.estimator.errors import MissingAck
from testbed.estimator.model import Ack


def report_of(factory: Any, **options: Any) -> Report:
    report = examine(Subject("conformance.plain:It", factory, options))
    assert [result.name for result in report.results] == [check.__name__ for check in CHECKS]
    for result in report.results:
        assert result.what
        assert len(result.text.splitlines()) == 1
    return report


def named(report: Report, status: str) -> dict[str, str]:
    return {result.name: result.text for result in report.results if result.status == status}


def test_a_sound_estimator_passes() -> None:
    report = report_of(Sound)
    assert named(report, "failed") == {}
    assert named(report, "skipped").keys() == {"entry_point"}
    assert report.conforms


@pytest.mark.parametrize("name", SPOILT)
def test_each_fault_is_caught_by_the_checks_that_are_for_it(name: str) -> None:
    factory, expected = SPOILT[name]
    report = report_of(factory)
    assert named(report, "failed").keys() == expected
    assert not report.conforms


def test_every_check_but_the_registration_catches_some_fault() -> None:
    caught = set[str]().union(*(checks for _, checks in SPOILT.values()))
    assert caught == {check.__name__ for check in CHECKS} - {"entry_point"}


def test_what_cannot_be_made_fails_once() -> None:
    def refuses(model: Any, lanes: int) -> Any:
        raise UsageError("never")

    def breaks(model: Any, lanes: int) -> Any:
        return 1 / 0

    for factory, expected in ((refuses, "raised UsageError: never"), (breaks, "raised ZeroDivisionError: ")):
        report = report_of(factory)
        failed = named(report, "failed")
        assert failed.keys() == {"declaration"}
        assert failed["declaration"].startswith(expected)
        assert set(named(report, "skipped").values()) == {"it cannot be made"}


def test_a_system_that_is_refused_is_left_out_and_named() -> None:
    class UpToTwo(Sound):
        def __init__(self, model: Any, lanes: int) -> None:
            super().__init__(model, lanes)
            if model.n == 3:
                raise UsageError("one or two states only")

    report = report_of(UpToTwo)
    assert report.conforms
    assert "refuses n = 3" in named(report, "passed")["declaration"]


def test_one_that_needs_acks_gets_them() -> None:
    class NeedsAcks(Sound):
        def nu(self, acks: tuple[Ack, ...]) -> Any:
            if not any(ack.j == self.k and ack.known.all() for ack in acks) and self.model.B is not None:
                raise MissingAck("ν is not known")
            return super().nu(acks)

    report = report_of(NeedsAcks)
    assert named(report, "failed") == {}
    assert "needs every ACK" in named(report, "passed")["declaration"]


def test_one_without_snapshots_passes_without_them() -> None:
    class Plain:
        def __init__(self, model: Any, lanes: int) -> None:
            self._inner = Sound(model, lanes)
            self.counters = self._inner.counters

        def step(self, u: Any, y: Any, arrived: Any, acks: Any = ()) -> Any:
            return self._inner.step(u, y, arrived, acks)

    report = report_of(Plain)
    assert report.conforms
    assert named(report, "skipped").keys() == {"restart", "hand_over", "entry_point"}


def test_what_is_declared_is_not_asked_and_shown_with_its_reason() -> None:
    class Modest(Sound):
        not_claimed: ClassVar[dict[str, str]] = {check.__name__: f"no\n{check.__name__}" for check in CLAIMS}

        def given(self, x: Any, P: Any) -> Any:
            return super().given(x, 0.8 * P)

    report = report_of(Modest)
    assert report.conforms
    assert named(report, "not claimed") == {check.__name__: f"no {check.__name__}" for check in CLAIMS}


def test_options_reach_the_estimator() -> None:
    class Scaled(Sound):
        def __init__(self, model: Any, lanes: int, scale: float = 1.0) -> None:
            super().__init__(model, lanes)
            self.scale = scale

        def given(self, x: Any, P: Any) -> Any:
            return super().given(x, self.scale * P)

    assert report_of(Scaled, scale=1.0).conforms
    assert "consistency" in named(report_of(Scaled, scale=0.2), "failed")


def test_lanes_to_rounding_are_lanes() -> None:
    class Rounds(Sound):
        def given(self, x: Any, P: Any) -> Any:
            return super().given(x * (1.0 + 1e-15 * (self.lanes > 1)), P)

    assert "within" in named(report_of(Rounds), "passed")["lanes"]
