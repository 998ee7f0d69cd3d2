"""What the actuator applies: a_k, in place of u_k where that is lost."""

from typing import Literal

from pydantic import Field

from testbed.scenario.base import Part

OnLoss = Literal["zero", "hold"]


class Actuator(Part):
    """What the plant applies at k: u_k where that packet arrived, and else what `on_loss` says."""

    on_loss: OnLoss = Field(
        default="zero",
        description="Where a control packet is lost; zero: nothing; hold: the input applied last, zero before the "
        "first arrival.",
    )
