"""Random systems with model error, and the example of R."""

from __future__ import annotations

import numpy as np

from testbed.estimator.model import Model
from testbed.numerics.lanes import Floats


def covariance(rng: np.random.Generator, size: int) -> Floats:
    root = rng.normal(size=(size, size))
    return np.asarray(root @ root.T + 0.3 * np.eye(size))


def random_model(seed: int, n: int, g: int, p: int, parameters: int) -> Model:
    """All of A, G, C depend on each of the parameters."""
    rng = np.random.default_rng(seed)
    G, W = rng.normal(size=(n, g)), covariance(rng, g)
    return Model(
        A=rng.normal(size=(n, n)) + np.eye(n),
        C=rng.normal(size=(p, n)),
        G=G,
        W=W,
        Q=G @ W @ G.T,
        R=covariance(rng, p),
        x0_mean=np.zeros(n),
        P0=covariance(rng, n),
        dA=tuple(rng.normal(size=(parameters, n, n))),
        dG=tuple(rng.normal(size=(parameters, n, g))),
        dC=tuple(rng.normal(size=(parameters, p, n))),
    )


def example_of_r(P0: float = 1.0) -> Model:
    """theory.md, R's example, from P_0 = ``P0`` times I."""
    Q = np.array([[1.9608, 0.0195], [0.0195, 1.9605]])
    return Model(
        A=np.array([[0.9802, 0.0196], [0.0, 0.9802]]),
        C=np.array([[1.0, -1.0]]),
        Q=Q,
        R=np.eye(1),
        x0_mean=np.array([1.0, 0.0]),
        P0=P0 * np.eye(2),
        dA=(np.array([[0.0, 0.099], [0.0, 0.0]]),),
    )
