"""The inputs u_k, k = 0, 1, …: only their data. q is the number of input channels."""

from typing import Annotated, Any, ClassVar, Literal

from pydantic import ConfigDict, Field, field_validator, model_validator

from testbed.scenario.base import Matrix, Part, ScalarOrVector, Vector, count, problem, sequence, shown
from testbed.scenario.closed_loop import ClosedLoop, FeedbackInput, LqgInput, PidInput, PythonInput
from testbed.scenario.system import System


def _positive(value: float | tuple[float, ...]) -> float | tuple[float, ...]:
    if any(entry <= 0 for entry in (value if isinstance(value, tuple) else (value,))):
        raise problem(f"got {shown(value)}; allowed: more than 0")
    return value


class ConstantInput(Part):
    """u_k = value."""

    kind: Literal["constant"] = Field(default="constant", description="Kind of input.")
    value: Vector = Field(description="The input, q numbers.")


class ExponentialInput(Part):
    """u_k = offset + amplitude * exp(-k / tau)."""

    kind: Literal["exponential"] = Field(default="exponential", description="Kind of input.")
    offset: ScalarOrVector = Field(default=0.0, description="What the input tends to: a number, or a list of q.")
    amplitude: ScalarOrVector = Field(default=1.0, description="What decays: a number, or a list of q.")
    tau: ScalarOrVector = Field(description="Steps in which it decays by the factor e, more than 0: a number, or q.")

    _check_tau = field_validator("tau")(_positive)


class SineInput(Part):
    """u_k = offset + amplitude * sin(2 pi k / period + phase)."""

    kind: Literal["sine"] = Field(default="sine", description="Kind of input.")
    offset: ScalarOrVector = Field(default=0.0, description="Mean of the input: a number, or a list of q.")
    amplitude: ScalarOrVector = Field(default=1.0, description="Amplitude: a number, or a list of q.")
    period: ScalarOrVector = Field(description="Period in steps, more than 0: a number, or a list of q.")
    phase: ScalarOrVector = Field(default=0.0, description="Phase at k = 0 in radians: a number, or a list of q.")

    _check_period = field_validator("period")(_positive)


class UniformInput(Part):
    """u_k drawn from the uniform law on [low, high], afresh at each step, from the seed of the scenario."""

    kind: Literal["uniform"] = Field(default="uniform", description="Kind of input.")
    low: ScalarOrVector = Field(description="Lower bound: a number, or a list of q.")
    high: ScalarOrVector = Field(description="Upper bound, not less than low: a number, or a list of q.")

    @model_validator(mode="after")
    def _ordered(self) -> "UniformInput":
        lows = self.low if isinstance(self.low, tuple) else (self.low,)
        highs = self.high if isinstance(self.high, tuple) else (self.high,)
        if len(lows) == 1 or len(highs) == 1 or len(lows) == len(highs):
            pairs = max(len(lows), len(highs))
            for low, high in zip(lows * (pairs // len(lows)), highs * (pairs // len(highs)), strict=True):
                if low > high:
                    raise problem(
                        f"got {shown(self.high)}; allowed: not less than low, which is {shown(self.low)}", "high"
                    )
        return self


def _table_schema(schema: dict[str, Any]) -> None:
    schema["properties"]["file"] = {
        "type": "string",
        "title": "File",
        "description": "CSV file, a row of q numbers for each step; its path is relative to the scenario's folder.",
    }
    schema["required"] = ["kind"]
    schema["oneOf"] = [{"required": ["values"]}, {"required": ["file"]}]


class TableInput(Part):
    """u_k = row k of a table. In the file: `file` (CSV, read by the loader) or `values`."""

    model_config = ConfigDict(json_schema_extra=_table_schema)
    other_keys: ClassVar[tuple[str, ...]] = ("file",)

    kind: Literal["table"] = Field(default="table", description="Kind of input.")
    values: Matrix = Field(description="A row of q numbers for each step k = 0, 1, …; at least as many as steps.")


Input = Annotated[
    ConstantInput
    | ExponentialInput
    | SineInput
    | UniformInput
    | TableInput
    | FeedbackInput
    | LqgInput
    | PidInput
    | PythonInput,
    Field(discriminator="kind"),
]


def check_channels(source: Input, system: System) -> None:
    """Check that every list of `source` has `q` entries, one for each channel; a problem of validation if not."""
    if isinstance(source, ClosedLoop):
        source.check_sizes(system)
        return
    q = system.q
    for key in type(source).model_fields:
        value = getattr(source, key)
        if key == "values":
            if len(value[0]) != q:
                unit = count(len(value[0]), "number") + " a row"
                raise problem(f"got {unit}; allowed: {q}, the number of columns of system.B", key)
        elif sequence(value) is not None and len(value) != q:
            raise problem(f"got {count(len(value), 'number')}; allowed: {q}, the number of columns of system.B", key)
