"""The kit in pytest: one test a check."""

from __future__ import annotations

from pathlib import Path

import pytest

from testbed.conformance.kit import CHECKS

pytest_plugins = ["pytester"]

SOUND = (Path(__file__).parent / "plain.py").read_text().replace("from __future__ import annotations", "")
MODULE = """
pytest_plugins = ["testbed.conformance.pytest_plugin"]
{source}

def test_conforms(conformance_check):
    conformance_check({name})
"""


@pytest.mark.parametrize(("name", "failed", "skipped"), [("Sound", 0, 1), ("Overconfident", 5, 1), ("'kfio'", 0, 0)])
def test_each_check_is_a_test(pytester: pytest.Pytester, name: str, failed: int, skipped: int) -> None:
    pytester.makepyfile(
        test_it=MODULE.format(source=SOUND.replace("from __future__ import annotations", ""), name=name)
    )
    result = pytester.runpytest_inprocess("-p", "no:cacheprovider", "-rs")
    result.assert_outcomes(passed=len(CHECKS) - failed - skipped, failed=failed, skipped=skipped)
    if failed:
        result.stdout.fnmatch_lines(["consistency: it is 3.* n (n = 1), P is too small; allowed: 0.7*1.4 n (wanted: *"])
    if skipped:
        result.stdout.fnmatch_lines(["SKIPPED*skipped: no package registers it in the group testbed.estimators*"])
