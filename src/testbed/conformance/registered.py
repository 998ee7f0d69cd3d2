"""Check of the registration, for estimators of other packages that have one."""

from __future__ import annotations

from importlib.metadata import entry_points

from testbed.conformance.result import Failed, Skipped
from testbed.conformance.subject import Subject
from testbed.estimator.registry import BUILT_IN, GROUP, create


def entry_point(subject: Subject) -> str:
    """a scenario can name it: it is registered, and its options are checked"""
    case = subject.cases[0]
    if subject.name in BUILT_IN:
        return f"built in as {subject.name!r}"
    points = [p for p in entry_points(group=GROUP) if subject.name in (p.name, p.value.replace(" ", ""))]
    if not points:
        raise Skipped(f"no package registers it in the group {GROUP}")
    for point in points:
        if point.name in BUILT_IN:
            raise Failed(f"it is registered as {point.name!r}, which is the name of a built-in one")
        made = create(point.name, case.model, lanes=case.lanes, options=subject.options)
        if type(made) is not type(subject.make(case)):
            raise Failed(f"{point.name!r} makes a {type(made).__name__}, not a {type(subject.make(case)).__name__}")
    return f"registered as {', '.join(repr(point.name) for point in points)}"
