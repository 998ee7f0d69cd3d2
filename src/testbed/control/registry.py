"""Controllers by the kind of input: those of the testbed, and those of others.

A package registers its own under the entry-point group ``testbed.controllers``; the object is called with
(model, lanes, **options), as an estimator is.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import lru_cache
from importlib.metadata import entry_points
from typing import get_args

import numpy as np

from testbed.control.controller import Controller
from testbed.control.feedback import StateFeedback, offset_of
from testbed.control.limits import Limits, channels
from testbed.control.lqg import Weights, horizon_gains, stationary_gain
from testbed.control.pid import Pid
from testbed.errors import UsageError, did_you_mean
from testbed.estimator.model import Model
from testbed.estimator.registry import model_of
from testbed.numerics.lanes import Floats
from testbed.plugins import checked_options, load_object
from testbed.scenario import FeedbackInput, Following, LqgInput, PidInput, PythonInput, Scenario

GROUP = "testbed.controllers"


def names() -> list[str]:
    """Controllers that other packages have registered."""
    return sorted({point.name for point in entry_points(group=GROUP)})


def create(source: Following, model: Model, *, lanes: int, steps: int, lane: int = 0) -> Controller:
    """A controller for the lanes lane … lane + lanes − 1 of a run of so many steps.

    Raises UsageError where an LQG controller has no gain, and where a controller of somebody's own does not exist, has
    wrong options, or is none.
    """
    if isinstance(source, FeedbackInput):
        gain = np.array(source.gain)
        feedforward = np.array(channels(source.feedforward, model.q))
        reference = np.zeros(model.n) if source.reference is None else np.array(source.reference)
        return StateFeedback(model, lanes, [gain], steps, offset_of(gain, reference, feedforward))
    if isinstance(source, LqgInput):
        return StateFeedback(model, lanes, lqg_gains(source, model, steps), steps, np.zeros(model.q))
    if isinstance(source, PidInput):
        return _pid(source, model, lanes)
    return _own(source, model, lanes, lane)


@lru_cache(maxsize=4)
def lqg_gains(source: LqgInput, model: Model, steps: int) -> tuple[Floats, ...]:
    """The gains of an LQG input, that of the last step first; one for a stationary horizon. Raises UsageError."""
    state = np.array(source.Qx)
    weights = Weights(state, np.array(source.Ru), state if source.terminal is None else np.array(source.terminal))
    if source.horizon == "run":
        return tuple(horizon_gains(model, weights, steps))
    return (stationary_gain(model, weights),)


def check(scenario: Scenario) -> None:
    """Raises UsageError where the controller of a scenario cannot be made, or does not do its first step."""
    source = scenario.input
    if not isinstance(source, get_args(Following)):
        return
    model = model_of(scenario)
    try:
        controller = create(source, model, lanes=1, steps=scenario.steps)
        if isinstance(source, PythonInput):
            checked_step(controller, 0, model.x0_mean[None].copy(), model.P0[None].copy(), model.q)
    except UsageError as error:
        raise UsageError(f"input: {error}") from None


def checked_step(controller: Controller, k: int, x_hat: Floats, P: Floats, q: int) -> Floats:
    """``controller.step``, as somebody else's. Raises UsageError where it raises, or does not return u_k (M, q)."""
    try:
        u = controller.step(k, x_hat, P)
        given = np.asarray(u, dtype=np.float64)
    except Exception as error:  # whatever a stranger's code raises
        text = " ".join(str(error).split())
        raise UsageError(f"the controller failed at step {k}: {type(error).__name__}: {text}") from None
    expected = (len(x_hat), q)
    if u is None:
        raise UsageError(f"the controller returned nothing at step {k}; needed: u of the shape {expected}")
    if given.shape != expected:
        raise UsageError(f"the controller returned the shape {given.shape} at step {k}; allowed: {expected}")
    if not np.isfinite(given).all():
        raise UsageError(f"the controller returned a value that is not finite at step {k}")
    return given


def _pid(source: PidInput, model: Model, lanes: int) -> Pid:
    return Pid(
        model,
        lanes,
        output=model.C if source.output is None else np.array(source.output),
        limits=Limits.of(source, model.q),
        setpoint=source.setpoint,
        kp=source.kp,
        ki=source.ki,
        kd=source.kd,
        filter=source.filter,
        feedforward=source.feedforward,
        tracking=source.tracking,
    )


def _own(source: PythonInput, model: Model, lanes: int, lane: int) -> Controller:
    factory, what = _factory(source.controller), f"controller {source.controller!r}"
    options = checked_options(what, factory, source.options)
    try:
        made = factory(model, lanes, **options)
    except UsageError:
        raise
    except Exception as error:  # whatever a stranger's code raises
        text = " ".join(str(error).split())
        raise UsageError(f"{what} cannot be made: {type(error).__name__}: {text}") from None
    if not callable(getattr(made, "step", None)):
        raise UsageError(f"{what} has no method 'step'; needed: step(k, x_hat, P)")
    begin_at = getattr(made, "begin_at", None)
    if begin_at is not None:
        begin_at(lane)
    found: Controller = made
    return found


def _factory(name: str) -> Callable[..., Controller]:
    if ":" in name:
        return load_object(name)
    for point in entry_points(group=GROUP, name=name):
        loaded: Callable[..., Controller] = point.load()
        return loaded
    listed = ", ".join(["MODULE:CLASS", *names()])
    raise UsageError(f"unknown controller {name!r}; allowed: {listed}{did_you_mean(name, names())}")
