"""Loss models: by which law packets are lost. Probabilities are per packet and lane."""

from typing import Annotated, Any, ClassVar, Literal

from pydantic import ConfigDict, Field, model_validator

from testbed.scenario.base import Part, Probability, Vector, number, probability, problem, shown

_LOSS = {"type": "number", "minimum": 0, "maximum": 1, "title": "Loss"}
_ROUNDING = 1e-12
_BURST = {"type": "number", "minimum": 1, "title": "Mean Burst"}


class NoLoss(Part):
    """Every packet arrives."""

    kind: Literal["none"] = Field(default="none", description="Kind of loss.")


def _bernoulli_schema(schema: dict[str, Any]) -> None:
    schema["properties"]["loss"] = _LOSS | {"description": "Probability that a packet is lost, 1 - arrival."}
    schema["required"] = ["kind"]
    schema["oneOf"] = [{"required": ["arrival"]}, {"required": ["loss"]}]


class BernoulliLoss(Part):
    """Each packet arrives with probability `arrival`, independently. In the file: `arrival` or `loss`."""

    model_config = ConfigDict(json_schema_extra=_bernoulli_schema)
    other_keys: ClassVar[tuple[str, ...]] = ("loss",)

    kind: Literal["bernoulli"] = Field(default="bernoulli", description="Kind of loss.")
    arrival: Probability = Field(description="Probability that a packet arrives, 0 … 1.")

    @model_validator(mode="before")
    @classmethod
    def _resolve(cls, data: Any) -> Any:
        if not isinstance(data, dict) or not set(data) <= set(cls.known_keys()):
            return data
        if ("arrival" in data) == ("loss" in data):
            raise problem(f"got {_listed(data, ('arrival', 'loss'))}; allowed: exactly one of arrival, loss")
        rest = dict(data)
        if "loss" in rest:
            rest["arrival"] = 1.0 - probability(rest.pop("loss"), "loss")
        return rest


def _markov_schema(schema: dict[str, Any]) -> None:
    schema["properties"]["loss"] = _LOSS | {"description": "Stationary probability that a packet is lost."}
    schema["properties"]["mean_burst"] = _BURST | {"description": "Mean length of a burst of losses, packets."}
    schema["required"] = ["kind"]
    schema["oneOf"] = [{"required": ["recovery", "failure"]}, {"required": ["loss", "mean_burst"]}]


class MarkovLoss(Part):
    """Arrivals are a two-state Markov chain (the simple Gilbert-Elliott channel), one step a packet.

    In the file: `recovery` and `failure`, or `loss` = failure / (recovery + failure) and `mean_burst` = 1 / recovery.
    """

    model_config = ConfigDict(json_schema_extra=_markov_schema)
    other_keys: ClassVar[tuple[str, ...]] = ("loss", "mean_burst")

    kind: Literal["markov"] = Field(default="markov", description="Kind of loss.")
    recovery: Probability = Field(description="Probability that a packet arrives after one that was lost, 0 … 1.")
    failure: Probability = Field(description="Probability that a packet is lost after one that arrived, 0 … 1.")
    start: Probability | None = Field(
        default=None, description="Probability that the first packet arrives, 0 … 1; left out: the stationary one."
    )

    @model_validator(mode="before")
    @classmethod
    def _resolve(cls, data: Any) -> Any:
        if not isinstance(data, dict) or not set(data) <= set(cls.known_keys()):
            return data
        keys = ("recovery", "failure", "loss", "mean_burst")
        given = [key for key in keys if key in data]
        if given not in (["recovery", "failure"], ["loss", "mean_burst"]):
            raise problem(f"got {_listed(data, keys)}; allowed: recovery and failure, or loss and mean_burst")
        rest = dict(data)
        if given[0] == "loss":
            rest["recovery"], rest["failure"] = _rates(rest.pop("loss"), rest.pop("mean_burst"))
        return rest

    @model_validator(mode="after")
    def _moves(self) -> "MarkovLoss":
        if self.recovery + self.failure == 0:
            raise problem("got recovery 0 and failure 0; allowed: recovery + failure more than 0")
        return self


class GilbertElliottLoss(Part):
    """The full Gilbert-Elliott channel: a hidden state, good or bad, and a probability of loss in each.

    A packet is lost with the probability of the state that it meets; then the state moves, one move a packet. In the
    words of `tc netem loss gemodel p r 1-h 1-k`: to_bad = p, to_good = r, loss_bad = 1-h, loss_good = 1-k.
    """

    kind: Literal["gilbert-elliott"] = Field(default="gilbert-elliott", description="Kind of loss.")
    to_bad: Probability = Field(description="Probability that a good state is followed by a bad one, 0 … 1.")
    to_good: Probability = Field(description="Probability that a bad state is followed by a good one, 0 … 1.")
    loss_good: Probability = Field(
        default=0.0, description="Probability that a packet is lost in the good state, 0 … loss_bad."
    )
    loss_bad: Probability = Field(default=1.0, description="Probability that a packet is lost in the bad state, 0 … 1.")
    start_good: Probability | None = Field(
        default=None, description="Probability that the first state is good, 0 … 1; left out: the stationary one."
    )

    @model_validator(mode="after")
    def _moves(self) -> "GilbertElliottLoss":
        if self.to_bad + self.to_good == 0:
            raise problem("got to_bad 0 and to_good 0; allowed: to_bad + to_good more than 0")
        if self.loss_good > self.loss_bad:
            raise problem(
                f"got {shown(self.loss_good)}; allowed with loss_bad {shown(self.loss_bad)}: "
                f"0 … {shown(self.loss_bad)}, the bad state being the one that loses more",
                "loss_good",
            )
        return self


class FourStateLoss(Part):
    """The four-state Markov model: good reception, bursts of losses with pauses in them, and isolated losses.

    A packet meets a state, which is its fate: it arrives in the good state (1) and in a pause (2), and is lost in a
    burst (3) and in the state of isolated losses (4), which good reception always follows. Then the state moves, one
    move a packet. In the words of `tc netem loss state p13 p31 p32 p23 p14`: to_burst = p13, to_good = p31,
    to_pause = p32, from_pause = p23, to_isolated = p14.
    """

    kind: Literal["four-state"] = Field(default="four-state", description="Kind of loss.")
    to_burst: Probability = Field(description="Probability that the good state is followed by a burst, 0 … 1.")
    to_good: Probability = Field(description="Probability that a loss in a burst is followed by the good state, 0 … 1.")
    to_pause: Probability = Field(
        default=0.0, description="Probability that a loss in a burst is followed by a pause, 0 … 1 - to_good."
    )
    from_pause: Probability = Field(
        default=1.0, description="Probability that a packet in a pause is followed by a loss, more than 0, at most 1."
    )
    to_isolated: Probability = Field(
        default=0.0, description="Probability that the good state is followed by an isolated loss, 0 … 1 - to_burst."
    )
    start: Vector | None = Field(
        default=None,
        description="Probabilities of the states 1 … 4 at the first packet; left out: those of the long run.",
    )

    @model_validator(mode="after")
    def _moves(self) -> "FourStateLoss":
        for key, other in (("to_isolated", "to_burst"), ("to_pause", "to_good")):
            value, rest = getattr(self, key), getattr(self, other)
            if value + rest > 1.0 + _ROUNDING:
                raise problem(
                    f"got {shown(value)}; allowed with {other} {shown(rest)}: 0 … {1.0 - rest:.6g}, so that they add "
                    "up to 1 at most",
                    key,
                )
        if self.to_burst + self.to_good == 0:
            raise problem("got to_burst 0 and to_good 0; allowed: to_burst + to_good more than 0")
        if self.from_pause == 0:
            raise problem("got 0.0; allowed: more than 0, so that a pause ends", "from_pause")
        start = self.start
        if start is not None and (len(start) != 4 or min(start) < 0.0 or abs(sum(start) - 1.0) > _ROUNDING):
            raise problem(f"got {shown(start)}; allowed: four numbers of 0 or more that add up to 1", "start")
        return self


LossLaw = Annotated[
    NoLoss | BernoulliLoss | MarkovLoss | GilbertElliottLoss | FourStateLoss, Field(discriminator="kind")
]


def _listed(data: dict[str, Any], keys: tuple[str, ...]) -> str:
    return " and ".join(key for key in keys if key in data) or "none of them"


def _rates(loss_given: object, mean_burst_given: object) -> tuple[float, float]:
    """(recovery, failure) of the chain with this stationary loss and mean length of a burst of losses."""
    loss = probability(loss_given, "loss")
    burst = number(mean_burst_given, "mean_burst", "1 or more")
    if burst < 1:
        raise problem(f"got {shown(mean_burst_given)}; allowed: 1 or more", "mean_burst")
    loss_max = burst / (1 + burst)
    if loss > loss_max:
        raise problem(
            f"got {shown(loss_given)}; allowed with mean_burst {shown(mean_burst_given)}: 0 … {loss_max:.6g}, "
            "that is mean_burst / (1 + mean_burst); more would need failure above 1",
            "loss",
        )
    return 1 / burst, min(1.0, loss / ((1 - loss) * burst))
