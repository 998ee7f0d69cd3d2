"""A Kalman filter with a constant gain: while it runs it solves no equation, and its P is that of its error."""

import numpy as np
from scipy.linalg import solve_discrete_are

from testbed.errors import UsageError
from testbed.estimator.model import Estimate
from testbed.numerics.lanes import matrix_of, vector_of


class FixedGain:
    not_claimed = {"kfio_with_acks": "its gain is that of the steady state, not that of its P"}

    def __init__(self, model, lanes, caution: float = 1.0):
        if not model.control.independent:
            raise UsageError("estimator 'fixed-gain' holds for i.i.d. control losses only")
        self.model, self.k, self.counters = model, 0, {"late_acks": 0}
        self.x, self.P = np.tile(model.x0_mean, (lanes, 1)), np.tile(model.P0, (lanes, 1, 1))
        S = solve_discrete_are(model.A.T, model.C.T, model.Q, caution * model.R)
        self.K = S @ model.C.T @ np.linalg.inv(model.C @ S @ model.C.T + caution * model.R)

    def step(self, u, y, arrived, acks=()):
        m, nu = self.model, np.full(len(u), self.model.control.first_arrival)
        for ack in acks:
            if ack.j == self.k:  # in time: ν itself in place of its mean
                nu = np.where(ack.known, ack.nu, nu)
            else:
                self.counters["late_acks"] += int(np.count_nonzero(ack.known))
        push = np.zeros_like(self.x) if m.B is None else u @ m.B.T
        spread = (nu * (1 - nu))[:, None, None] * push[:, :, None] * push[:, None, :]
        x, P = self.x @ m.A.T + nu[:, None] * push, m.A @ self.P @ m.A.T + m.Q + spread
        K = arrived[:, None, None] * self.K
        L = np.eye(m.n) - K @ m.C
        self.k, self.x = self.k + 1, x + np.einsum("mnp,mp->mn", K, y - x @ m.C.T)
        self.P = L @ P @ L.transpose(0, 2, 1) + K @ m.R @ K.transpose(0, 2, 1)
        return Estimate(vector_of(self.x), matrix_of(self.P), len(u))
