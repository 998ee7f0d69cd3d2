"""Controllers for tests, made from the keys of ``[input]``."""

from __future__ import annotations

from typing import Any, cast

import numpy as np
from numpy.typing import NDArray

from testbed.control.controller import RestartableController
from testbed.control.registry import create
from testbed.estimator.registry import model_of
from testbed.scenario import Scenario, parse_scenario

SYSTEM: dict[str, Any] = {
    "A": [[1.1, 0.2], [0.0, 0.7]],
    "B": [[1.0, 0.3], [-0.5, 1.0]],
    "C": [[1.0, 0.5], [0.0, 1.0]],
    "Q": [[0.5, 0.1], [0.1, 0.3]],
    "R": [[0.4, 0.0], [0.0, 0.4]],
}
"""Two inputs, two outputs."""
STATES_SHAPE = (3, 2)
"""Three lanes."""


def closed(source: dict[str, Any], **changes: Any) -> Scenario:
    tables = {"steps": 10, "system": SYSTEM, "estimators": [{"name": "kfio", "acks": "perfect"}], **changes}
    return parse_scenario({**tables, "input": source})


def made(source: dict[str, Any], lanes: int = 1, **changes: Any) -> RestartableController:
    scenario = closed(source, **changes)
    controller = create(scenario.input, model_of(scenario), lanes=lanes, steps=scenario.steps)  # type: ignore[arg-type]
    return cast(RestartableController, controller)


def answers(controller: Any, states: NDArray[np.float64], first: int = 0) -> NDArray[np.float64]:
    """u_k for x̂_k = states[k], (K, M, n)."""
    P = np.tile(np.eye(states.shape[2]), (states.shape[1], 1, 1))
    return np.array([controller.step(first + k, x_hat, P) for k, x_hat in enumerate(states)])
