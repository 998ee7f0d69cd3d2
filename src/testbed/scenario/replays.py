"""Losses that no law draws: those of a trace, and those of a list. Estimators need a law for them all the same."""

import re
from typing import Annotated, Any, ClassVar, Literal

from pydantic import BeforeValidator, ConfigDict, Field, WithJsonSchema, model_validator

from testbed.scenario.base import COUNT_MAX, Part, count, problem, sequence, shown
from testbed.scenario.loss_laws import BernoulliLoss, LossLaw, MarkovLoss, NoLoss

WORD_PATTERN = r"^[01]+$"
_ASSUMED = (
    "What estimators and theorems take the losses for, a loss of kind none, bernoulli, markov, gilbert-elliott or "
    "four-state; left out: the Markov chain of the transitions counted {where}, from the last packet to the first too."
)


def _trace_schema(schema: dict[str, Any]) -> None:
    schema["properties"]["file"] = {
        "type": "string",
        "title": "File",
        "description": "Trace, a CSV file with the columns seq, sent_ns, delivered_ns; relative to the scenario.",
    }
    schema["required"] = ["kind"]
    schema["oneOf"] = [{"required": ["fates"]}, {"required": ["file"]}]


class TraceLoss(Part):
    """The fates of the packets of a trace, in the order of seq. In the file: `file` (read by the loader) or `fates`.

    Delays and duplicates of the trace are not replayed: a packet arrives if one of its rows has delivered_ns.
    """

    model_config = ConfigDict(json_schema_extra=_trace_schema)
    other_keys: ClassVar[tuple[str, ...]] = ("file",)

    kind: Literal["trace"] = Field(default="trace", description="Kind of loss.")
    fates: str = Field(pattern=WORD_PATTERN, description="A letter for each packet: 1 arrived, 0 lost.")
    offset: int | None = Field(
        default=None,
        ge=0,
        le=COUNT_MAX,
        description="Packet of the trace, from 0, that the first packet of every lane is; left out: 0, or with repeat "
        "one for each lane, drawn from the seed.",
    )
    repeat: bool = Field(
        default=True, description="Whether the trace begins again at its end; false: a longer run is refused."
    )
    assumed: LossLaw | None = Field(default=None, description=_ASSUMED.format(where="in the trace"))

    @model_validator(mode="after")
    def _within(self) -> "TraceLoss":
        if self.offset is not None and self.offset >= len(self.fates):
            last = len(self.fates) - 1
            raise problem(f"got {self.offset}; allowed: 0 … {last}, the last packet of the trace", "offset")
        return self

    @property
    def law(self) -> LossLaw:
        """``assumed``, or by counts."""
        return self.assumed or _counted_word(self.fates)

    def of_run(self, packets: int) -> "TraceLoss":
        """For a run of so many packets, with its law. A problem of validation where the trace is shorter."""
        begin = self.offset or 0
        if not self.repeat and begin + packets > len(self.fates):
            raise problem(
                f"got {count(len(self.fates) - begin, 'packet')} from offset {begin} on with repeat false; allowed: at "
                f"least {packets}, one for each step, or repeat = true",
                "fates",
            )
        return self.model_copy(update={"assumed": self.law})


Range = tuple[int, int]
"""From first to last, both lost."""
_RANGE = re.compile(r"\s*([0-9]{1,10})\s*-\s*([0-9]{1,10})\s*", re.ASCII)


def _range(entry: object) -> Range | None:
    if isinstance(entry, str):
        match = _RANGE.fullmatch(entry)
        first, last = (int(match[1]), int(match[2])) if match else (1, 0)
    elif isinstance(entry, int) and not isinstance(entry, bool):
        first = last = entry
    else:
        return None
    return (first, last) if 0 <= first <= last <= COUNT_MAX else None


def _to_lost(value: object) -> tuple[int | str, ...]:
    entries = sequence(value)
    if not entries:
        raise problem(f'got {shown(value)}; allowed: a list of packet numbers and ranges, such as [3, 4, "10-12"]')
    for i, entry in enumerate(entries):
        if _range(entry) is None:
            raise problem(f'got {shown(entry)}; allowed: a number from 0, or a range such as "10-12"', f"[{i}]")
    return tuple(entries)


Lost = Annotated[
    tuple[int | str, ...],
    BeforeValidator(_to_lost),
    WithJsonSchema(
        {
            "type": "array",
            "minItems": 1,
            "items": {
                "anyOf": [
                    {"type": "integer", "minimum": 0, "maximum": COUNT_MAX},
                    {"type": "string", "pattern": r"^\s*[0-9]{1,10}\s*-\s*[0-9]{1,10}\s*$"},
                ]
            },
        }
    ),
]


def _scripted_schema(schema: dict[str, Any]) -> None:
    schema["oneOf"] = [{"required": ["lost"]}, {"required": ["pattern"]}]


class ScriptedLoss(Part):
    """Exactly these packets are lost, in every lane. The first packet is number 0: u_0, y_1 and the first ACK are."""

    model_config = ConfigDict(json_schema_extra=_scripted_schema)

    kind: Literal["scripted"] = Field(default="scripted", description="Kind of loss.")
    lost: Lost | None = Field(
        default=None, description='The numbers of the packets that are lost, and ranges of them: [3, 4, "10-12"].'
    )
    pattern: Annotated[str, Field(pattern=WORD_PATTERN)] | None = Field(
        default=None, description="A letter for each packet, over and over again: 1 arrives, 0 is lost."
    )
    assumed: LossLaw | None = Field(
        default=None, description=_ASSUMED.format(where="in the pattern, or with `lost` over the steps of the run")
    )

    @model_validator(mode="after")
    def _one_of_both(self) -> "ScriptedLoss":
        if (self.lost is None) == (self.pattern is None):
            given = "neither" if self.lost is None else "both"
            raise problem(f"got {given} of lost and pattern; allowed: exactly one of lost, pattern")
        return self

    @property
    def ranges(self) -> tuple[Range, ...]:
        """What ``lost`` says, in order, with at least one packet that arrives between two ranges."""
        merged: list[Range] = []
        for first, last in sorted(found for entry in self.lost or () if (found := _range(entry)) is not None):
            if merged and first <= merged[-1][1] + 1:
                merged[-1] = merged[-1][0], max(last, merged[-1][1])
            else:
                merged.append((first, last))
        return tuple(merged)

    @property
    def law(self) -> LossLaw:
        """``assumed``, or by counts; those of ``lost`` up to the packet after the last one."""
        return self.assumed or self._counted((self.ranges or ((0, 0),))[-1][1] + 2)

    def of_run(self, packets: int) -> "ScriptedLoss":
        """For a run of so many packets, with its law."""
        return self.model_copy(update={"assumed": self.assumed or self._counted(packets)})

    def _counted(self, packets: int) -> LossLaw:
        if self.pattern is not None:
            return _counted_word(self.pattern)
        inside = [(first, min(last, packets - 1)) for first, last in self.ranges if first < packets]
        lost = sum(last - first + 1 for first, last in inside)
        around = bool(inside) and inside[0][0] == 0 and inside[-1][1] == packets - 1 and len(inside) > 1
        return _counted(packets, lost, len(inside) - around)


def _counted_word(word: str) -> LossLaw:
    return _counted(len(word), word.count("0"), (word + word[0]).count("10"))


def _counted(packets: int, lost: int, bursts: int) -> LossLaw:
    """The Markov chain of the transitions around the circle, so that its stationary loss is the share that was lost."""
    if lost == 0:
        return NoLoss()
    if lost == packets:
        return BernoulliLoss(arrival=0.0)
    return MarkovLoss(recovery=bursts / lost, failure=bursts / (packets - lost))
