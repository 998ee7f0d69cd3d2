"""Every estimator of the testbed passes the kit, and what one does not claim it does not do."""

from __future__ import annotations

import pytest

from testbed.conformance.kit import CLAIMS, examine, examine_by
from testbed.conformance.load import subject_of
from testbed.estimator.registry import kinds

OPTIONS = {"pf": {"particles": 400}}
NOT_CLAIMED = {
    "pf": {"coordinates", "kfio_with_acks"},
    "rsemm": {"consistency", "kfio_with_acks"},
}


@pytest.mark.parametrize("kind", kinds())
def test_a_built_in_estimator_conforms(kind: str) -> None:
    report = examine(subject_of(kind, OPTIONS.get(kind, {})))
    of = {status: {r.name for r in report.results if r.status == status} for status in ("failed", "skipped")}
    assert of == {"failed": set(), "skipped": set()}
    assert {r.name for r in report.results if r.status == "not claimed"} == NOT_CLAIMED.get(kind, set())


@pytest.mark.parametrize("kind", NOT_CLAIMED)
def test_what_a_built_in_one_does_not_claim_it_does_not_do(kind: str) -> None:
    subject = subject_of(kind, OPTIONS.get(kind, {}))
    subject.__dict__["not_claimed"] = {}
    failed = {check.__name__ for check in CLAIMS if examine_by(check, subject).status == "failed"}
    assert failed - {"hand_over"} == NOT_CLAIMED[kind]
