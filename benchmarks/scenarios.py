"""The scenario that all benchmarks of whole runs use: 2 states, Markov losses on both links, AOE.

The plant is stable: a long run of an unstable one without feedback leaves the floating-point range.
"""

from __future__ import annotations

from testbed.scenario import Scenario, parse_scenario

_TEXT = """
name = "benchmark"
seed = 1
[system]
A = [[0.95, 0.10], [0.0, 0.90]]
B = [[-1.0], [1.0]]
C = [[1.0, -1.0], [0.0, 1.0]]
Q = [[0.2, 0.0], [0.0, 0.2]]
R = [[0.5, 0.0], [0.0, 0.5]]
[input]
kind = "exponential"
offset = 1.0
amplitude = 1.0
tau = 10.0
[links.control]
loss = { kind = "markov", recovery = 0.5, failure = 0.3 }
[links.observation]
loss = { kind = "markov", recovery = 0.6, failure = 0.2 }
[[estimators]]
name = "aoe"
"""

_CLOSED = (
    _TEXT[: _TEXT.index("[input]")]
    + """
[input]
kind = "feedback"
gain = [[0.01, 0.02]]
estimator = "aoe"
"""
    + _TEXT[_TEXT.index("[links.control]") :]
)


def scenario(
    *,
    steps: int,
    lanes: int = 1,
    window: int | None = None,
    bounds: bool = False,
    record: str = "none",
    closed: bool = False,
) -> Scenario:
    """The benchmark scenario of that size; ``window`` None: as the testbed chooses; closed: u follows the estimate."""
    base: Scenario = parse_scenario(_CLOSED if closed else _TEXT)
    changed = {"steps": steps, "lanes": lanes, "bounds": bounds, "record": record}
    clock = base.clock.model_copy(update={"window": window})
    return base.model_copy(update={**changed, "clock": clock})
