"""PID controllers, one for each input channel, on outputs z = H x̂ (q of them). The step is the unit of time.

    e_k = setpoint − z_k
    D_k = (T D_{k−1} − kd (z_k − z_{k−1})) / (T + 1),   D_{−1} = 0, z_{−1} = z_0    (T: filter; backward difference)
    v_k = feedforward + kp e_k + I_k + D_k,   I_0 = 0
    u_k = v_k within the limits
    I_{k+1} = I_k + ki e_k + (u_k − v_k) / tracking                 with tracking (back-calculation)
    I_{k+1} = I_k + ki e_k unless (v_k − u_k) ki e_k > 0            without (conditional integration)

The forms of Åström and Hägglund, *Advanced PID Control* (2006): the derivative acts on the output alone, so that a new
set point gives no kick. With a time step of h seconds and gains K, K/Ti, K Td of the textbook: kp = K, ki = K h/Ti,
kd = K Td/h, filter = Tf/h.
"""

from __future__ import annotations

import numpy as np

from testbed.control.limits import Channels, Limits, channels
from testbed.estimator.model import Model
from testbed.estimator.state import Given, State, state_of
from testbed.numerics.lanes import Floats, Vector, array_of, constant, constant_times, full_vector, vector_of, where


class Pid:
    """Made from the keys of ``[input]``; output (q, n)."""

    STATE_VERSION = 1

    def __init__(
        self,
        model: Model,
        lanes: int,
        *,
        output: Floats,
        limits: Limits,
        setpoint: Channels = 0.0,
        kp: Channels = 0.0,
        ki: Channels = 0.0,
        kd: Channels = 0.0,
        filter: Channels = 0.0,
        feedforward: Channels = 0.0,
        tracking: Channels | None = None,
    ) -> None:
        q = len(output)
        self._n, self._lanes, self._limits = model.n, lanes, limits
        self._output = constant(output)
        self._setpoint, self._feedforward = channels(setpoint, q), channels(feedforward, q)
        self._kp, self._ki, self._kd, self._filter = (channels(v, q) for v in (kp, ki, kd, filter))
        self._tracking = None if tracking is None else channels(tracking, q)
        self._k = 0
        self._integral: Vector = full_vector(np.zeros(q), lanes)
        self._derivative: Vector = full_vector(np.zeros(q), lanes)
        self._before: Vector = full_vector(np.zeros(q), lanes)

    def step(self, k: int, x_hat: Floats, P: Floats) -> Floats:
        z = constant_times(self._output, vector_of(x_hat))
        before = z if k == 0 else self._before
        v: Vector = []
        errors: Vector = []
        derivative: Vector = []
        for i, output in enumerate(z):
            error = self._setpoint[i] - output
            t = self._filter[i]
            slope = (t * self._derivative[i] - self._kd[i] * (output - before[i])) / (t + 1.0)
            v.append(self._feedforward[i] + self._kp[i] * error + self._integral[i] + slope)
            errors.append(error)
            derivative.append(slope)
        self._integrate(errors, v)
        self._k, self._derivative, self._before = k + 1, derivative, [o + 0.0 for o in z]
        return array_of(v, self._lanes)

    def _integrate(self, errors: Vector, v: Vector) -> None:
        """I_{k+1} in each channel."""
        u = self._limits.clipped(v)
        integral: Vector = []
        for i, error in enumerate(errors):
            now, more = self._integral[i], self._ki[i] * error
            if not self._limits.given:
                integral.append(now + more)
            elif self._tracking is not None:
                integral.append(now + more + (u[i] - v[i]) / self._tracking[i])
            else:
                integral.append(where((v[i] - u[i]) * more > 0.0, now, now + more))
        self._integral = integral

    def state(self) -> State:
        parts = {"integral": self._integral, "derivative": self._derivative, "before": self._before}
        return state_of(self._k, self._lanes, parts)

    def set_state(self, state: State) -> None:
        given = Given(state, self._lanes, self._n)
        q = len(self._output)
        integral, derivative, before = (given.vector(name, q) for name in ("integral", "derivative", "before"))
        given.end()
        self._k, self._integral, self._derivative, self._before = given.step, integral, derivative, before
