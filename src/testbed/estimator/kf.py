"""KF: the Kalman filter that takes every received y as a measurement, also one that is only noise (theory.md 3.8)."""

from __future__ import annotations

from testbed.estimator.kfio import Kfio


class Kf(Kfio):
    """KFIO without the indicator γ: what a packet with γ = 0 brought is a measurement to it."""

    kind = "kf"
    takes_every_y = True
