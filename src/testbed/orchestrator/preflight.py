"""What can be known to be wrong before anything starts."""

from __future__ import annotations

from pathlib import Path

from testbed.control.registry import check as check_controller
from testbed.errors import UsageError
from testbed.estimator.buffers import acks_of
from testbed.estimator.registry import check, model_of
from testbed.scenario import Scenario
from testbed.scenario.backend import real_links


def check_parts(scenario: Scenario) -> None:
    """Raises UsageError for an estimator that does not exist, has wrong options, or cannot run in this scenario.

    The same for the controller of a closed loop.
    """
    if not scenario.estimators:
        raise UsageError("the scenario has no [[estimators]]; a run needs at least one")
    model = model_of(scenario)
    for spec in scenario.estimators:
        check(spec, model, acks=acks_of(scenario, spec), scenario=scenario)
    check_controller(scenario)


def check_processes(scenario: Scenario) -> None:
    """Raises UsageError for links that need real time and processes, where there are none."""
    names = real_links(scenario)
    if names:
        backend = getattr(scenario.links, names[0]).backend
        raise UsageError(
            f"links.{names[0]}.backend: got {backend!r} with --in-process; allowed there: model (--links model), or "
            "without --in-process"
        )


def prepare_folder(out: Path) -> None:
    """Make the run's folder. Raises UsageError where that cannot be, or nothing can be written there."""
    probe = out / ".writable"
    try:
        out.mkdir(parents=True, exist_ok=True)
        probe.write_bytes(b"")
        probe.unlink()
    except OSError as error:
        raise UsageError(f"cannot write into {out}: {(error.strerror or str(error)).lower()}") from None
