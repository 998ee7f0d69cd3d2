"""Comparison of runs, lane by lane."""

from testbed.orchestrator.comparison.compare import Comparison, Item, Pair, compare
from testbed.orchestrator.comparison.runs import RunFigures, load_run, load_runs

__all__ = ["Comparison", "Item", "Pair", "RunFigures", "compare", "load_run", "load_runs"]
