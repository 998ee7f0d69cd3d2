"""The three links, and what happens to their packets."""

from typing import Any, ClassVar, Literal

from pydantic import ConfigDict, Field, model_validator
from pydantic_core import PydanticCustomError

from testbed.scenario.base import Part, problem, shown
from testbed.scenario.carriers import LinkTransport, TcpTransport
from testbed.scenario.durations import Duration, parse_duration
from testbed.scenario.impairments import Corrupt, Delay, Duplicate, Rate, Reorder
from testbed.scenario.loss_laws import LossLaw, NoLoss
from testbed.scenario.losses import Loss
from testbed.scenario.presets import presets
from testbed.scenario.replays import ScriptedLoss, TraceLoss


class Impairments(Part):
    """What happens to the packets of one direction of a link, in the order of the keys (see docs: links)."""

    loss: Loss = Field(default_factory=NoLoss, description="Which packets are lost; default none.")
    up: bool = Field(
        default=True,
        description="Whether anything gets through; false only in changes of a run, where a partition sets it. Draws "
        "and chains go on meanwhile.",
    )
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


def _link_schema(schema: dict[str, Any]) -> None:
    schema["properties"]["preset"] = {
        "type": "string",
        "title": "Preset",
        "enum": list(presets()),
        "description": "Name of a preset, whose keys hold where the table does not give them; the control link is one "
        "down, from the network to the device, the others are up.",
    }


Backend = Literal["model", "relay", "kernel"]
"""What a link of a run is made of."""


class SteppedImpairments(Impairments):
    """A link of a run, whose packets belong to steps."""

    model_config = ConfigDict(json_schema_extra=_link_schema)
    other_keys: ClassVar[tuple[str, ...]] = ("preset",)

    backend: Backend = Field(
        default="model",
        description="model: simulated; relay: two real zenoh sessions with a relay between them, on the wall clock; "
        "kernel: two real zenoh sessions in two network namespaces, on the wall clock. Real sessions talk over UDP, "
        "with transport 'tcp' over TCP.",
    )
    deadline: Duration | None = Field(
        default=None,
        description="Time after sending within which a packet counts for its step, at most the period; left out: the "
        "period. A later observation or ACK counts as late, a later control packet as lost.",
    )
    assumed: LossLaw | None = Field(
        default=None,
        description="What estimators take the losses for, lateness counted as loss; left out: what follows from the "
        "other keys, or where there is no formula for it, a Markov chain fitted to a sample of the link.",
    )

    transport: LinkTransport | None = Field(
        default=None,
        description="What carries the messages: datagrams, or a connection that retransmits; left out: a packet a "
        "message, with nothing around it.",
    )
    back: Impairments | None = Field(
        default=None,
        description="What happens to what a connection sends back (acknowledgements, answers); only with transport "
        "'tcp'; left out: the same as forwards.",
    )

    @model_validator(mode="after")
    def _back_with_tcp(self) -> "SteppedImpairments":
        if self.back is not None and not isinstance(self.transport, TcpTransport):
            raise problem("got a table without transport 'tcp'; allowed: only with it", "back")
        return self

    @property
    def backwards(self) -> Impairments:
        """What happens to what a connection sends back."""
        return self if self.back is None else self.back.model_copy(update={"up": self.up})

    @property
    def takes_time(self) -> bool:
        """Whether a packet may arrive late, twice or spoilt, or meet a chain that is not moved by packets."""
        stages = (self.slot, self.rate, self.delay, self.reorder, self.duplicate, self.corrupt, self.transport)
        return self.is_real or any(stage is not None for stage in stages)

    @property
    def is_real(self) -> bool:
        """Whether its packets go through real sockets, in real time."""
        return self.backend != "model"

    def deadline_ns(self, period_ns: int) -> int:
        """The deadline in nanoseconds."""
        return period_ns if self.deadline is None else parse_duration(self.deadline)


class Link(SteppedImpairments):
    """A link that carries packets one way."""


class ObservationLink(Link):
    """The link of the observations."""

    on_loss: Literal["nothing", "noise"] = Field(
        default="nothing",
        description="What comes of a lost packet; nothing: only that it is lost; noise: that, and the sensor noise v.",
    )


class AckLink(SteppedImpairments):
    """What the estimators are told about the arrival of control packets."""

    mode: Literal["none", "perfect", "link"] = Field(
        default="none",
        description="none: nothing (UDP-like); perfect: everything, at once (TCP-like); link: over a link of its own.",
    )

    batch: int = Field(
        default=1, ge=1, le=4096, description="Outcomes that an ACK carries: those of the last so many control packets."
    )

    @model_validator(mode="after")
    def _impaired_needs_link(self) -> "AckLink":
        if self.mode == "link":
            return self
        if not isinstance(self.loss, NoLoss):
            raise problem(
                f"got kind {self.loss.kind!r} with mode {self.mode!r}; allowed: only with mode 'link'", "loss"
            )
        for key, field in type(self).model_fields.items():
            value = getattr(self, key)
            if key not in ("mode", "loss") and value != field.default:
                text = "a table" if isinstance(value, Part) else shown(value)
                raise problem(f"got {text} with mode {self.mode!r}; allowed: only with mode 'link'", key)
        return self


class Links(Part):
    """The three links."""

    control: Link = Field(default_factory=Link, description="Controller to plant: u.")
    observation: ObservationLink = Field(default_factory=ObservationLink, description="Plant to estimators: y.")
    ack: AckLink = Field(default_factory=AckLink, description="Plant to estimators: which u were applied.")

    @model_validator(mode="after")
    def _up_at_first(self) -> "Links":
        for name in type(self).model_fields:
            if not getattr(self, name).up:
                raise problem("got false; allowed: true, and an event 'partition' with at = 0", f"{name}.up")
        return self

    def of_run(self, packets: int, period_ns: int) -> "Links":
        """For a run of so many packets a link: replayed losses with their law. A problem of validation if one ends."""
        update = {}
        for name in type(self).model_fields:
            link: Impairments = getattr(self, name)
            if isinstance(link.loss, (TraceLoss, ScriptedLoss)):
                try:
                    slot_ns = period_ns if link.slot is None else parse_duration(link.slot)
                    fates = packets if link.slot is None else (packets - 1) * period_ns // slot_ns + 1
                    update[name] = link.model_copy(update={"loss": link.loss.of_run(fates)})
                except PydanticCustomError as error:
                    context = error.context or {}
                    raise problem(context["text"], f"{name}.loss.{context['at']}") from None
        return self.model_copy(update=update)
