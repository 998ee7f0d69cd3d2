"""KF: the Kalman filter that knows no γ and takes every y that it receives as a measurement (theory.md 3.7)."""

from __future__ import annotations

from typing import ClassVar

from testbed.estimator.kfio import Kfio


class Kf(Kfio):
    """KFIO, but for what it takes as a measurement: noise too, where that is received in place of a lost packet.

    Its model is the nominal one. ν must be known, as for KFIO.
    """

    KIND: ClassVar[str] = "kf"
    takes_noise: ClassVar[bool] = True
