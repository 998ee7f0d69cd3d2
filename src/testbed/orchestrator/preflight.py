"""What can be known to be wrong before anything starts."""

from __future__ import annotations

from pathlib import Path

from testbed.errors import UsageError
from testbed.estimator.buffers import acks_of
from testbed.estimator.registry import check, model_of
from testbed.scenario import Scenario


def check_estimators(scenario: Scenario) -> None:
    """Raises UsageError for an estimator that does not exist, has wrong options, or cannot run in this scenario."""
    if not scenario.estimators:
        raise UsageError("the scenario has no [[estimators]]; a run needs at least one")
    model = model_of(scenario)
    for spec in scenario.estimators:
        check(spec, model, acks=acks_of(scenario, spec), scenario=scenario)


def prepare_folder(out: Path) -> None:
    """Make the run's folder. Raises UsageError where that cannot be, or nothing can be written there."""
    probe = out / ".writable"
    try:
        out.mkdir(parents=True, exist_ok=True)
        probe.write_bytes(b"")
        probe.unlink()
    except OSError as error:
        raise UsageError(f"cannot write into {out}: {(error.strerror or str(error)).lower()}") from None
