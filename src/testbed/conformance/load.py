"""From what the user names to the estimator under examination."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from testbed.conformance.subject import Subject
from testbed.errors import UsageError, did_you_mean
from testbed.estimator.registry import checked_options, factory_of, kinds
from testbed.plugins import load_object


def subject_of(name: str, options: Mapping[str, Any]) -> Subject:
    """MODULE:OBJECT, the module also from the working folder, or the kind of a registered estimator.

    Raises UsageError where there is no such module, object or kind, where it cannot be imported,
    and for a wrong option.
    """
    if ":" in name:
        factory = load_object(name)
    elif name in kinds():
        factory = factory_of(name)
    else:
        listed = ", ".join(kinds())
        raise UsageError(f"{name}: no such estimator; allowed: MODULE:OBJECT, or {listed}{did_you_mean(name, kinds())}")
    return Subject(name, factory, checked_options(name, factory, dict(options)))
