"""RSEMM, a reconstruction: RSE with γ̄C in place of C, γ̄ the stationary arrival rate (theory.md 3.7)."""

from __future__ import annotations

from dataclasses import replace
from functools import lru_cache
from typing import Annotated, ClassVar

from annotated_types import Gt, Le

from testbed.estimator.model import Model
from testbed.estimator.rse import Rse


class Rsemm(Rse):
    """A reconstruction from one sentence, not the published estimator: do not report its figures as those.

    Every y that is received is taken as γ̄C(ε)x + v. Where nothing is received it predicts.
    """

    KIND: ClassVar[str] = "rsemm"
    not_claimed: ClassVar[dict[str, str]] = {
        "kfio_with_acks": "it takes y for γ̄C x + v, also where y arrived and is C x + v",
        "consistency": "its P leaves out the bias that γ̄C in place of C brings",
    }

    def __init__(self, model: Model, lanes: int, mu: Annotated[float, Gt(0), Le(1)] = 0.8) -> None:
        super().__init__(_faded(model), lanes, mu)


@lru_cache(maxsize=16)
def _faded(model: Model) -> Model:
    """The model with γ̄C."""
    rate = model.observation.arrival
    return replace(model, C=rate * model.C, dC=tuple(rate * d for d in model.dC))
