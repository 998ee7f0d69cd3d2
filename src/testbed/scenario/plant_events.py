"""Events of what is controlled: another input, and a plant whose parameters drift."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field, model_validator

from testbed.scenario.base import Count, Matrix, problem
from testbed.scenario.inputs import ConstantInput, ExponentialInput, SineInput, TableInput, UniformInput
from testbed.scenario.moments import AnyEvent

OpenLoop = Annotated[
    ConstantInput | ExponentialInput | SineInput | UniformInput | TableInput, Field(discriminator="kind")
]


class InputEvent(AnyEvent):
    """u_k is that of another open-loop input, for this k and all later ones; k counts from the start of the run."""

    action: Literal["input"] = Field(description="Another input.")
    input: OpenLoop = Field(description="The input: a table as [input], of a kind that follows no estimate.")


PARAMETERS = ("A", "B", "C", "Q", "R", "G")


class PlantEvent(AnyEvent):
    """The plant gets other parameters; the estimators keep their model, those of [system].

    From step s on: x_{k+1} = A x_k + ν_k B u_k + G w_k for k ≥ s, and y_k = C x_k + v_k for k ≥ s.
    """

    action: Literal["plant"] = Field(description="The plant drifts away from the model.")
    A: Matrix | None = Field(default=None, description="Dynamics, n x n.")
    B: Matrix | None = Field(default=None, description="Input, n x q; only with system.B.")
    C: Matrix | None = Field(default=None, description="Measurement, p x n.")
    Q: Matrix | None = Field(default=None, description="Covariance of the process noise, g x g.")
    R: Matrix | None = Field(default=None, description="Covariance of the measurement noise, p x p.")
    G: Matrix | None = Field(default=None, description="Entry of the process noise, n x g.")
    over: Count = Field(
        default=1,
        description="Steps in which the values change in a straight line: at step at + i they have gone "
        "(i + 1) / over of the way.",
    )

    @property
    def values(self) -> dict[str, Matrix]:
        """What changes."""
        return {key: value for key in PARAMETERS if (value := getattr(self, key)) is not None}

    @model_validator(mode="after")
    def _something(self) -> PlantEvent:
        if not self.values:
            raise problem(f"got none of {', '.join(PARAMETERS)}; allowed: one or more of them")
        return self
