"""What a link does to a packet besides losing it: rate and queue, delay, order, copies, bit errors.

The losses are in losses.py. What a link of these does, stage by stage, is in testbed.channel.pipeline.
"""

from typing import Annotated, Any, ClassVar, Literal

from pydantic import BeforeValidator, ConfigDict, Field, model_validator

from testbed.scenario.base import Count, Part, Probability, problem, shown, to_vector
from testbed.scenario.durations import Duration, DurationOrZero, parse_duration


class Rate(Part):
    """A bottleneck: a token bucket, and a queue before it that drops what comes when it is full."""

    bits_per_second: float = Field(gt=0.0, le=1e15, description="Rate at which tokens come, more than 0.")
    burst_bytes: int = Field(
        default=0,
        ge=0,
        le=2**40,
        description="Depth of the bucket: so much leaves at once after a pause; 0: a line that sends bit after bit.",
    )
    queue_packets: Count | None = Field(
        default=None, description="Packets that may wait or be on their way into the line; left out: no limit."
    )
    queue_bytes: Count | None = Field(default=None, description="Bytes that may do so; left out: no limit.")
    overhead_bytes: int = Field(default=0, ge=0, le=65535, description="Bytes that the line adds to each packet.")


class ConstantDelay(Part):
    """Every packet takes the same time."""

    kind: Literal["constant"] = Field(default="constant", description="Kind of delay.")
    by: DurationOrZero = Field(description="The delay, such as '10 ms'.")


class _Varying(Part):
    in_order: bool = Field(
        default=False, description="Whether a packet waits for those before it; false: it may overtake them."
    )


class UniformDelay(_Varying):
    """The delay is uniform between two bounds."""

    kind: Literal["uniform"] = Field(default="uniform", description="Kind of delay.")
    low: DurationOrZero = Field(description="Least delay.")
    high: DurationOrZero = Field(description="Greatest delay, not less than low.")

    @model_validator(mode="after")
    def _ordered(self) -> "UniformDelay":
        if parse_duration(self.high, zero=True) < parse_duration(self.low, zero=True):
            raise problem(f"got {shown(self.high)}; allowed: not less than low, which is {shown(self.low)}", "high")
        return self


class NormalDelay(_Varying):
    """The delay is normal, given that it is not less than `minimum`: the normal law cut off there."""

    kind: Literal["normal"] = Field(default="normal", description="Kind of delay.")
    mean: DurationOrZero = Field(description="Mean of the law before it is cut off.")
    std: Duration = Field(description="Its standard deviation.")
    minimum: DurationOrZero = Field(default="0 s", description="Least delay.")

    @model_validator(mode="after")
    def _reachable(self) -> "NormalDelay":
        mean, std, least = (parse_duration(text, zero=True) for text in (self.mean, self.std, self.minimum))
        if least > mean + 6 * std:
            raise problem(f"got {shown(self.minimum)}; allowed: at most mean + 6 std", "minimum")
        return self


class LogNormalDelay(_Varying):
    """minimum + median * exp(sigma * z), z standard normal."""

    kind: Literal["log-normal"] = Field(default="log-normal", description="Kind of delay.")
    median: Duration = Field(description="Median of what comes on top of the minimum.")
    sigma: float = Field(ge=0.0, le=5.0, description="Standard deviation of its logarithm, 0 … 5.")
    minimum: DurationOrZero = Field(default="0 s", description="Least delay.")


def _table_schema(schema: dict[str, Any]) -> None:
    schema["properties"]["file"] = {
        "type": "string",
        "title": "File",
        "description": "CSV file, one delay a row; its path is relative to the scenario's folder.",
    }
    schema["required"] = ["kind"]
    schema["oneOf"] = [{"required": ["values"]}, {"required": ["file"]}]


def _delays(value: object) -> tuple[float, ...]:
    values = to_vector(value)
    for i, entry in enumerate(values):
        if entry < 0.0:
            raise problem(f"got {shown(entry)}; allowed: 0 or more", f"[{i}]")
    return values


class TableDelay(_Varying):
    """Delays drawn from measured ones, each as likely as any other. In the file: `values`, or `file` (CSV)."""

    model_config = ConfigDict(json_schema_extra=_table_schema)
    other_keys: ClassVar[tuple[str, ...]] = ("file",)

    kind: Literal["table"] = Field(default="table", description="Kind of delay.")
    unit: Literal["ns", "us", "ms", "s"] = Field(default="ms", description="Unit of the values.")
    values: Annotated[tuple[float, ...], Field(min_length=1), BeforeValidator(_delays)] = Field(
        description="Measured delays, 0 or more."
    )


Delay = Annotated[ConstantDelay | UniformDelay | NormalDelay | LogNormalDelay | TableDelay, Field(discriminator="kind")]


class Reorder(Part):
    """Some packets are held back, so that later ones overtake them."""

    chance: Probability = Field(description="Probability that a packet is held back, 0 … 1.")
    by: Duration = Field(description="For how long.")


class Duplicate(Part):
    """Some packets arrive twice."""

    chance: Probability = Field(description="Probability that a packet is duplicated, 0 … 1.")
    after: DurationOrZero = Field(default="0 s", description="How long after the packet its copy arrives.")


class Corrupt(Part):
    """Some packets arrive with one bit flipped. Where a checksum guards them, the receiver drops them."""

    chance: Probability = Field(description="Probability that a bit is flipped, 0 … 1; for each copy by itself.")
