"""RSE: RSEIO that knows no γ and takes every y that it receives as a measurement (theory.md 3.7)."""

from __future__ import annotations

from typing import ClassVar

from testbed.estimator.rseio import Rseio


class Rse(Rseio):
    """RSEIO, but for what it takes as a measurement: noise too, where that is received in place of a lost packet."""

    KIND: ClassVar[str] = "rse"
    takes_noise: ClassVar[bool] = True
