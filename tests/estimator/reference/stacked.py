"""The system as one linear map of its noises, so that conditioning is one solve and needs no recursion.

With ξ = (x_0 - x̄_0, w_0, …, w_{k-1}, v_1, …, v_k) and a history h of control losses,

    x_j = A^j x̄_0 + Σ_{i<j} A^{j-1-i} B a_i(h) + X_j ξ,     y_j = C x_j + v_j = … + Y_j ξ,     cov ξ block diagonal,

and a_i(h) = h_i u_i, or what the actuator holds.
"""

from __future__ import annotations

import numpy as np
from numpy.linalg import matrix_power
from scipy.linalg import block_diag

from estimator.reference.cases import Bools, Floats, System


class Stack:
    """The joint law of x_k and the received y_1 … y_k. `extra` (n, n) is process noise on top of Q."""

    def __init__(self, system: System, arrived: Bools, extra: Floats | None = None) -> None:
        """arrived (k,): which observations are received."""
        n, p, k = system.n, system.p, len(arrived)
        Q = system.Q if extra is None else system.Q + extra
        self.system = system
        self.k = k
        self.received = [j for j in range(1, k + 1) if arrived[j - 1]]
        self.noise_cov = np.asarray(block_diag(system.P0, *[Q] * k, *[system.R] * k), dtype=np.float64)
        unit = np.eye(n + k * n + k * p)
        self._w = [unit[n * (i + 1) : n * (i + 2)] for i in range(k)]
        self._v = [unit[n * (k + 1) + p * j : n * (k + 1) + p * (j + 1)] for j in range(k)]
        self._x0 = unit[:n]
        self.X = self.state_map(k)
        self.H = np.vstack([np.zeros((0, unit.shape[0])), *(self.output_map(j) for j in self.received)])
        self.S = self.H @ self.noise_cov @ self.H.T
        cross = self.H @ self.noise_cov @ self.X.T
        self.gain = np.asarray(np.linalg.solve(self.S, cross).T, dtype=np.float64)
        rest = self.X - self.gain @ self.H
        self.cov: Floats = rest @ self.noise_cov @ rest.T

    def state_map(self, j: int) -> Floats:
        """X_j: x_j less its mean, as a map of ξ."""
        A = self.system.A
        terms = [matrix_power(A, j) @ self._x0, *(matrix_power(A, j - 1 - i) @ self._w[i] for i in range(j))]
        return np.asarray(np.sum(terms, axis=0), dtype=np.float64)

    def output_map(self, j: int) -> Floats:
        """Y_j: y_j less its mean, as a map of ξ."""
        return self.system.C @ self.state_map(j) + self._v[j - 1]

    def state_means(self, u: Floats, histories: Floats, j: int) -> Floats:
        """Mean of x_j for each history: u (k, q), histories (N, k) → (N, n)."""
        A, B = self.system.A, self.system.B
        means = np.tile(matrix_power(A, j) @ self.system.x0_mean, (len(histories), 1))
        applied = self.system.applied(u[:j], histories[:, :j])
        for i in range(j):
            means += applied[:, i] @ (matrix_power(A, j - 1 - i) @ B).T
        return means

    def output_means(self, u: Floats, histories: Floats) -> Floats:
        """Means of the received y, stacked: (N, p · number received)."""
        means = [self.state_means(u, histories, j) @ self.system.C.T for j in self.received]
        return np.hstack([np.zeros((len(histories), 0)), *means])

    def posterior_means(self, u: Floats, y: Floats, histories: Floats) -> Floats:
        """E[x_k | received y, history] for each history: u (k, q), y (k, p) → (N, n)."""
        surprise = self._stack(y) - self.output_means(u, histories)
        return self.state_means(u, histories, self.k) + surprise @ self.gain.T

    def log_densities(self, u: Floats, y: Floats, histories: Floats) -> Floats:
        """log p(received y | history): (N,)."""
        return self._log_normal(self._stack(y) - self.output_means(u, histories))

    def log_densities_of_lanes(self, u: Floats, y: Floats, history: Floats) -> Floats:
        """log p(received y | history) for many y: u (k, q), y (k, M, p), history (k,) → (M,)."""
        stacked = np.hstack([np.zeros((y.shape[1], 0)), *(y[j - 1] for j in self.received)])
        return self._log_normal(stacked - self.output_means(u, history[None, :]))

    def _log_normal(self, errors: Floats) -> Floats:
        root = np.linalg.cholesky(self.S)
        white = np.linalg.solve(root, errors.T)
        constant = float(np.log(np.diag(root)).sum()) + len(root) / 2 * np.log(2 * np.pi)
        return np.asarray(-0.5 * (white**2).sum(axis=0) - constant, dtype=np.float64)

    def _stack(self, y: Floats) -> Floats:
        return np.concatenate([np.zeros(0), *(y[j - 1] for j in self.received)])
