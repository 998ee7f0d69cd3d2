"""A run that a script steers while it goes: ``Scenario.start`` begins one."""

from testbed.orchestrator.live.actions import Moment
from testbed.orchestrator.live.figures import EstimatorStep, Figures
from testbed.orchestrator.live.ordered import Ordered
from testbed.orchestrator.live.run import LiveRun, start

__all__ = ["EstimatorStep", "Figures", "LiveRun", "Moment", "Ordered", "start"]
