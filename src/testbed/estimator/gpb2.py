"""GPB2: a Gaussian for each value of the last ν, which is GPB of order 1 (theory.md 3.5)."""

from __future__ import annotations

from testbed.estimator.gpb import Gpb
from testbed.estimator.model import Model


class Gpb2(Gpb):
    """The generalised pseudo-Bayesian estimator of second order, as the literature on multiple models counts."""

    def __init__(self, model: Model, lanes: int) -> None:
        super().__init__(model, lanes, order=1)
