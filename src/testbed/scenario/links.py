"""The three links."""

from typing import ClassVar, Literal

from pydantic import Field, model_validator

from testbed.scenario.base import Part, problem
from testbed.scenario.losses import Loss, NoLoss


class Link(Part):
    """A link that carries packets one way."""

    later_keys: ClassVar[tuple[str, ...]] = ("delay",)

    loss: Loss = Field(default_factory=NoLoss, description="Which packets are lost; default none.")


class ObservationLink(Link):
    """The link of the observations."""

    on_loss: Literal["nothing", "noise"] = Field(
        default="nothing",
        description="What comes of a lost packet; nothing: only that it is lost; noise: that, and the sensor noise v.",
    )


class AckLink(Part):
    """What the estimators are told about the arrival of control packets."""

    later_keys: ClassVar[tuple[str, ...]] = ("delay",)

    mode: Literal["none", "perfect", "link"] = Field(
        default="none",
        description="none: nothing (UDP-like); perfect: everything, at once (TCP-like); link: over a link of its own.",
    )
    loss: Loss = Field(default_factory=NoLoss, description="Which acknowledgements are lost; only with mode link.")

    @model_validator(mode="after")
    def _loss_needs_link(self) -> "AckLink":
        if self.mode != "link" and not isinstance(self.loss, NoLoss):
            raise problem(
                f"got kind {self.loss.kind!r} with mode {self.mode!r}; allowed: only with mode 'link'", "loss"
            )
        return self


class Links(Part):
    """The three links."""

    control: Link = Field(default_factory=Link, description="Controller to plant: u.")
    observation: ObservationLink = Field(default_factory=ObservationLink, description="Plant to estimators: y.")
    ack: AckLink = Field(default_factory=AckLink, description="Plant to estimators: which u were applied.")
