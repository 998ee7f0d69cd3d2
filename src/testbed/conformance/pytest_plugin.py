"""For pytest: the kit as one test a check.

In a test module or the top ``conftest.py``:

    pytest_plugins = ["testbed.conformance.pytest_plugin"]

and then a test that uses the fixture, which runs once for each check:

    def test_conforms(conformance_check):
        conformance_check(MyEstimator, gain=0.5)
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import pytest

from testbed.conformance.kit import CHECKS, Check, examine_by
from testbed.conformance.load import subject_of
from testbed.conformance.subject import Subject

_FIXTURE = "conformance_check"


def pytest_generate_tests(metafunc: pytest.Metafunc) -> None:
    if _FIXTURE in metafunc.fixturenames:
        metafunc.parametrize(_FIXTURE, CHECKS, indirect=True, ids=[check.__name__ for check in CHECKS])


@pytest.fixture
def conformance_check(request: pytest.FixtureRequest) -> Callable[..., None]:
    """Called with an estimator, or its MODULE:OBJECT or kind, and its options: fails, or skips, with the reason."""
    check: Check = request.param

    def run(estimator: str | Callable[..., Any], **options: Any) -> None:
        if isinstance(estimator, str):
            subject = subject_of(estimator, options)
        else:
            subject = Subject(f"{estimator.__module__}:{estimator.__qualname__}", estimator, options)
        result = examine_by(check, subject)
        if result.status == "failed":
            pytest.fail(f"{result.name}: {result.text} (wanted: {result.what})", pytrace=False)
        if result.status != "passed":
            pytest.skip(f"{result.status}: {result.text}")

    return run
