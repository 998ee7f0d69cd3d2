"""The estimators of a scenario, as far as they are known without their code."""

import math
from typing import Annotated, Any, ClassVar, Literal

from pydantic import ConfigDict, Field, model_validator

from testbed.scenario.base import COUNT_MAX, Count, Part, problem, sequence, shown

NAME_PATTERN = r"^[a-z][a-z0-9_-]{0,31}$"
NAME_ALLOWED = "1 to 32 of a-z, 0-9, _ and -, a letter first"

Name = Annotated[str, Field(pattern=NAME_PATTERN)]


def _schema(schema: dict[str, Any]) -> None:
    """In the file the options are keys of the estimator's own table."""
    del schema["properties"]["options"]
    schema["additionalProperties"] = True


def _own_name(data: dict[str, Any]) -> Any:
    return data["name"]


class _WithOptions(Part):
    """A table whose keys that are not fields are its `options`."""

    model_config = ConfigDict(json_schema_extra=_schema)
    reserved: ClassVar[tuple[str, ...]]

    @model_validator(mode="before")
    @classmethod
    def _gather_options(cls, data: Any) -> Any:
        if not isinstance(data, dict):
            return data
        given = data.get("options", {})
        if not isinstance(given, dict):
            raise problem(
                f"got {shown(given)}; allowed: a table, or its keys beside {', '.join(cls.reserved)}", "options"
            )
        for key in given:
            if key in cls.model_fields:
                raise problem(
                    f"got the reserved key {key!r}; allowed: any key but {', '.join(cls.model_fields)}", "options"
                )
        own = {key: value for key, value in data.items() if key in cls.reserved}
        rest = {key: value for key, value in data.items() if key not in cls.model_fields}
        own["options"] = plain_options({**given, **rest})
        return own


class EstimatorSpec(_WithOptions):
    """An estimator. Keys of its table that are not fields here are its `options`."""

    reserved: ClassVar[tuple[str, ...]] = ("name", "kind", "acks", "until", "buffer")

    name: Name = Field(description="Name in the results; unique.")
    kind: Name = Field(default_factory=_own_name, description="Which estimator it is; default its name.")
    acks: Literal["none", "perfect"] | None = Field(
        default=None, description="What it is told of the control packets; left out: that of [links.ack]."
    )
    until: Count | None = Field(
        default=None, description="The last step at which it runs, 1 … steps; left out: the last step of all."
    )
    buffer: int | None = Field(
        default=None,
        ge=0,
        le=COUNT_MAX,
        description="Steps that it can go back when an observation or ACK comes late, 0 or more; left out: "
        "20 where links can be late, else 0.",
    )
    options: dict[str, Any] = Field(default_factory=dict, description="Every other key of its table.")


class NewService(_WithOptions):
    """What estimates from an event on. Keys of its table that are not fields here are its `options`."""

    reserved: ClassVar[tuple[str, ...]] = ("kind", "acks", "until", "buffer")

    kind: Name = Field(description="Which estimator it is.")
    acks: Literal["none", "perfect"] | None = Field(
        default=None,
        description="What it is told of the control packets; left out: as the one before or beside it, or that of "
        "[links.ack].",
    )
    until: Count | None = Field(default=None, description="The last step at which it runs; left out: the last of all.")
    buffer: int | None = Field(
        default=None,
        ge=0,
        le=COUNT_MAX,
        description="Steps that it can go back when an observation or ACK comes late; left out: as the one before or "
        "beside it, or as in [[estimators]].",
    )
    options: dict[str, Any] = Field(default_factory=dict, description="Every other key of its table.")

    def named(self, name: str, like: EstimatorSpec | None = None) -> EstimatorSpec:
        """As an estimator of the scenario, with the ACKs and the buffer of ``like`` where it has none of its own."""
        return EstimatorSpec(
            name=name,
            kind=self.kind,
            acks=self.acks if self.acks is not None or like is None else like.acks,
            until=self.until,
            buffer=self.buffer if self.buffer is not None or like is None else like.buffer,
            options=self.options,
        )


def plain_options(options: dict[str, Any]) -> dict[str, Any]:
    """Options as TOML can hold them; a problem of validation if one is something else."""
    return {key: _plain_value(value, key) for key, value in options.items()}


def _plain_value(value: Any, at: str) -> Any:
    """`value` if it is made of true/false, finite numbers, texts, lists and tables; a problem of validation if not."""
    if isinstance(value, dict):
        return {key: _plain_value(entry, f"{at}.{key}") for key, entry in value.items()}
    entries = sequence(value)
    if entries is not None:
        return [_plain_value(entry, f"{at}[{i}]") for i, entry in enumerate(entries)]
    if isinstance(value, int) and not isinstance(value, bool) and not -(2**63) <= value < 2**63:
        raise problem(f"got {shown(value)}; allowed: an integer of 64 bits", at)
    if isinstance(value, (bool, int, str)) or (isinstance(value, float) and math.isfinite(value)):
        return value
    raise problem(f"got {shown(value)}; allowed: true or false, a finite number, a text, a list or a table", at)
