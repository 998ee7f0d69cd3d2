"""The checks, and an examination by all of them."""

from __future__ import annotations

import inspect
from collections.abc import Callable

import numpy as np

from testbed.conformance import form, restart, theory
from testbed.conformance.registered import entry_point
from testbed.conformance.result import Failed, Report, Result, Skipped
from testbed.conformance.subject import Subject
from testbed.errors import did_you_mean

Check = Callable[[Subject], str]
"""Its docstring says what it wants. It returns what it found, or raises Failed or Skipped; all else is a failure."""

CLAIMS: tuple[Check, ...] = (
    theory.coordinates,
    theory.kfio_with_acks,
    theory.ack_bound,
    theory.consistency,
    restart.hand_over,
)
"""Those that an estimator may declare in ``not_claimed``."""


def declaration(subject: Subject) -> str:
    """it can be made with (model, lanes), and not_claimed names checks that it may name"""
    subject.make(subject.cases[0])
    declared, allowed = subject.not_claimed, [check.__name__ for check in CLAIMS]
    for name, reason in declared.items():
        if name not in allowed:
            raise Failed(f"not_claimed: {name!r}; allowed: {', '.join(allowed)}{did_you_mean(name, allowed)}")
        if not isinstance(reason, str) or not reason.strip():
            raise Failed(f"not_claimed: {name!r} has no reason")
    losses = "i.i.d. control losses only" if subject.control.independent else "Markov control losses"
    acks = "needs every ACK" if subject.delays else "needs no ACK"
    refused = "".join(f"; refuses {name}" for name in subject.refused)
    return f"{losses}; {acks}{refused}; {len(declared)} not claimed"


CHECKS: tuple[Check, ...] = (
    declaration,
    form.shapes,
    form.finite,
    form.symmetric,
    form.positive,
    form.no_control,
    form.inputs_kept,
    form.outputs_kept,
    form.lost_y_ignored,
    form.deterministic,
    form.lanes,
    theory.coordinates,
    theory.kfio_with_acks,
    theory.late_acks,
    theory.ack_bound,
    theory.consistency,
    theory.long_losses,
    restart.restart,
    restart.hand_over,
    entry_point,
)


def examine(subject: Subject) -> Report:
    """All checks of one estimator; of one that cannot be made, the first alone."""
    first = examine_by(CHECKS[0], subject)
    try:
        subject.make(subject.cases[0])
    except (Exception, SystemExit):  # whatever a stranger's code raises; the first check has failed with it
        rest = [Result(c.__name__, inspect.getdoc(c) or "", "skipped", "it cannot be made") for c in CHECKS[1:]]
    else:
        rest = [examine_by(check, subject) for check in CHECKS[1:]]
    return Report(subject.name, (first, *rest))


def examine_by(check: Check, subject: Subject) -> Result:
    """One check of one estimator. Nothing that the estimator raises gets out."""
    name, what = check.__name__, inspect.getdoc(check) or ""
    try:
        if check in CLAIMS and name in subject.not_claimed:
            return Result(name, what, "not claimed", _line(str(subject.not_claimed[name])) or "no reason given")
        with np.errstate(all="ignore"):
            return Result(name, what, "passed", check(subject))
    except Skipped as reason:
        return Result(name, what, "skipped", _line(str(reason)))
    except Failed as failure:
        return Result(name, what, "failed", _line(str(failure)))
    except (Exception, SystemExit) as error:  # whatever a stranger's code raises is its failure
        return Result(name, what, "failed", _line(f"raised {type(error).__name__}: {error}"))


def _line(text: str) -> str:
    return " ".join(text.split())
