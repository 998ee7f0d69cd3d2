"""Slow tests: skipped unless asked for, and the end of the output says so. Those marked root: where they cannot run."""

from __future__ import annotations

import fcntl
import tempfile
from collections.abc import Iterator
from pathlib import Path

import pytest

_REASON = "slow: run with --run-slow"


def pytest_addoption(parser: pytest.Parser) -> None:
    parser.addoption("--run-slow", action="store_true", help="also run the tests marked slow")


def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    _skip_without_namespaces([item for item in items if "root" in item.keywords])
    if config.getoption("--run-slow"):
        return
    for item in items:
        if "slow" in item.keywords:
            item.add_marker(pytest.mark.skip(reason=_REASON))


def _skip_without_namespaces(items: list[pytest.Item]) -> None:
    if not items:
        return
    from testbed.channel.kernel.doctor import examine

    finding = next(finding for finding in examine() if finding.what == "hosts, backend tun")
    if not finding.ok:
        for item in items:
            item.add_marker(pytest.mark.skip(reason=f"root: {finding.found}"))


@pytest.fixture(autouse=True)
def _one_with_hosts_at_a_time(request: pytest.FixtureRequest) -> Iterator[None]:
    """Across processes: each removes what dead owners left, and some want to see that themselves."""
    if "root" not in request.keywords:
        yield
        return
    with (Path(tempfile.gettempdir()) / "testbed-tests-hosts.lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        yield


def pytest_terminal_summary(terminalreporter: pytest.TerminalReporter) -> None:
    skipped = [r for r in terminalreporter.stats.get("skipped", []) if _REASON in str(r.longrepr)]
    if skipped:
        terminalreporter.write_line(f"slow tests skipped: {len(skipped)}; --run-slow runs them too")
