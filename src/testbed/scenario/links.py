"""The three links, and what happens to their packets."""

from typing import Literal

from pydantic import Field, model_validator

from testbed.scenario.base import Part, problem, shown
from testbed.scenario.durations import Duration
from testbed.scenario.impairments import Corrupt, Delay, Duplicate, Rate, Reorder
from testbed.scenario.losses import Loss, NoLoss


class Impairments(Part):
    """What happens to the packets of one direction of a link, in the order of the keys (see docs: links)."""

    loss: Loss = Field(default_factory=NoLoss, description="Which packets are lost; default none.")
    clock: Literal["packet", "time"] = Field(
        default="packet", description="What moves the chain of the losses: each packet, or time, once a slot."
    )
    slot: Duration | None = Field(
        default=None, description="Time between two moves of the chain; only with clock 'time', where it is required."
    )
    rate: Rate | None = Field(default=None, description="Bottleneck with its queue; left out: none.")
    delay: Delay | None = Field(default=None, description="Time on the way; left out: none.")
    reorder: Reorder | None = Field(default=None, description="Packets held back; left out: none.")
    duplicate: Duplicate | None = Field(default=None, description="Packets that arrive twice; left out: none.")
    corrupt: Corrupt | None = Field(default=None, description="Packets with a bit flipped; left out: none.")

    @model_validator(mode="after")
    def _slot_with_time(self) -> "Impairments":
        if (self.clock == "time") != (self.slot is not None):
            given = "nothing" if self.slot is None else shown(self.slot)
            allowed = "a duration such as '10 ms'" if self.slot is None else "only with clock = 'time'"
            raise problem(f"got {given} with clock {self.clock!r}; allowed: {allowed}", "slot")
        return self


class Link(Impairments):
    """A link that carries packets one way."""


class ObservationLink(Link):
    """The link of the observations."""

    on_loss: Literal["nothing", "noise"] = Field(
        default="nothing",
        description="What comes of a lost packet; nothing: only that it is lost; noise: that, and the sensor noise v.",
    )


class AckLink(Impairments):
    """What the estimators are told about the arrival of control packets."""

    mode: Literal["none", "perfect", "link"] = Field(
        default="none",
        description="none: nothing (UDP-like); perfect: everything, at once (TCP-like); link: over a link of its own.",
    )

    @model_validator(mode="after")
    def _impaired_needs_link(self) -> "AckLink":
        if self.mode == "link":
            return self
        if not isinstance(self.loss, NoLoss):
            raise problem(
                f"got kind {self.loss.kind!r} with mode {self.mode!r}; allowed: only with mode 'link'", "loss"
            )
        for key in Impairments.model_fields:
            value = getattr(self, key)
            if key != "loss" and value != Impairments.model_fields[key].default:
                text = "a table" if isinstance(value, Part) else shown(value)
                raise problem(f"got {text} with mode {self.mode!r}; allowed: only with mode 'link'", key)
        return self


class Links(Part):
    """The three links."""

    control: Link = Field(default_factory=Link, description="Controller to plant: u.")
    observation: ObservationLink = Field(default_factory=ObservationLink, description="Plant to estimators: y.")
    ack: AckLink = Field(default_factory=AckLink, description="Plant to estimators: which u were applied.")
