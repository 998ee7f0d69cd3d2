"""Conditions of events: a small language over the figures of a run, such as `trace_P(aoe) > 500 for 10 steps`."""

from testbed.scenario.conditions.condition import Condition
from testbed.scenario.conditions.figures import Names, StepFigures

__all__ = ["Condition", "Names", "StepFigures"]
