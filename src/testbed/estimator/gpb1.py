"""GPB1: one Gaussian and the posterior of the last ν, which is GPB of order 0 (theory.md 3.5)."""

from __future__ import annotations

from testbed.estimator.gpb import Gpb
from testbed.estimator.model import Model


class Gpb1(Gpb):
    """The generalised pseudo-Bayesian estimator of first order, as the literature on multiple models counts."""

    def __init__(self, model: Model, lanes: int) -> None:
        super().__init__(model, lanes, order=0)
