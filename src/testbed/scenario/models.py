"""The scenario as a whole."""

from collections.abc import Sequence
from importlib import import_module
from os import PathLike
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal, TypeVar

from pydantic import Field, ValidationError, ValidationInfo, field_validator

from testbed.errors import UsageError, did_you_mean
from testbed.scenario.actuator import Actuator
from testbed.scenario.base import Count, Part, count, plain, problem, shown
from testbed.scenario.changes import changed, in_turn
from testbed.scenario.closed_loop import ClosedLoop, FeedbackInput, LqgInput, PidInput, PythonInput
from testbed.scenario.cost import Cost
from testbed.scenario.durations import format_duration, parse_duration
from testbed.scenario.estimator_events import ESTIMATOR_EVENTS, EstimatorEvent
from testbed.scenario.estimators import EstimatorSpec
from testbed.scenario.event_checks import Surroundings, check_events
from testbed.scenario.events import Event, HealEvent, LinkEvent, PartitionEvent
from testbed.scenario.files import resolve_files
from testbed.scenario.inputs import ConstantInput, Input, TableInput, check_channels
from testbed.scenario.link_timeline import changes_in
from testbed.scenario.links import AckLink, Links, SteppedImpairments
from testbed.scenario.moments import AnyEvent
from testbed.scenario.plant_events import PlantEvent
from testbed.scenario.recovery import Recovery
from testbed.scenario.services import Planned, planned
from testbed.scenario.system import System
from testbed.scenario.transport import Clock, Transport
from testbed.scenario.uncertainty import Uncertainty

if TYPE_CHECKING:
    from testbed.orchestrator.live import LiveRun

E = TypeVar("E", bound=AnyEvent)

SEED_MAX = 2**63 - 1
SLOTS_A_PERIOD = 1000
"""Moves of a chain by time, from packet to packet, at most."""

Following = FeedbackInput | LqgInput | PidInput | PythonInput
"""The inputs of a closed loop."""


def _no_input(data: dict[str, Any]) -> ConstantInput | None:
    """u = 0 if the system has an input, and nothing if it has none."""
    system: System = data["system"]
    return ConstantInput(value=(0.0,) * system.q) if system.q else None


def _cost_of_input(data: dict[str, Any]) -> Cost | None:
    """The cost that an LQG controller minimises; none for any other input."""
    source = data.get("input")
    return Cost(Qx=source.Qx, Ru=source.Ru, terminal=source.terminal) if isinstance(source, LqgInput) else None


class Scenario(Part):
    """Everything that determines a run: the same scenario and seed give the same results.

    In Python its tables are keywords, with values as in the file: ``Scenario(steps=50, system={"A": [[1.0]], …})``.
    """

    name: str = Field(
        default="scenario",
        min_length=1,
        max_length=128,
        pattern=r"^[^\x00-\x1f\x7f]+$",
        description="Name in the results, on one line.",
    )
    steps: Count = Field(default=100, description="Number of steps, k = 1 … steps.")
    lanes: Count = Field(default=1, description="Number of independent realisations that run side by side.")
    seed: int = Field(default=1, ge=0, le=SEED_MAX, description="Seed of every random draw.")
    record: Literal["first", "all", "none"] = Field(default="first", description="Which lanes the recording keeps.")
    bounds: bool = Field(default=True, description="Whether the bounds of the error covariance are computed.")
    clock: Clock = Field(default_factory=Clock, description="How time passes.")
    system: System = Field(description="The system.")
    uncertainty: Uncertainty | None = Field(default=None, description="Model error of the plant; left out: none.")
    estimators: Annotated[tuple[EstimatorSpec, ...], Field(strict=False)] = Field(
        default=(), description="The estimators, all on the same packets."
    )
    actuator: Actuator = Field(default_factory=Actuator, description="What the plant applies where u is lost.")
    input: Input | None = Field(default_factory=_no_input, description="The input u; default zero. Only with system.B.")
    cost: Cost | None = Field(
        default_factory=_cost_of_input,
        description="What deviations and inputs cost; left out: the weights of an LQG input, or no cost.",
    )
    links: Links = Field(default_factory=Links, description="The links between the parts.")
    transport: Transport = Field(default_factory=Transport, description="How the processes of a run talk.")
    recovery: Recovery = Field(
        default_factory=Recovery, description="What becomes of the run when one of its processes is lost."
    )
    events: Annotated[tuple[Event, ...], Field(strict=False)] = Field(
        default=(), description="The timeline: what happens while the run goes."
    )

    def __init__(self, /, **tables: Any) -> None:
        """Relative paths are taken from the current folder. Raises UsageError, of one line."""
        from testbed.scenario.explain import explain

        try:
            super().__init__(**resolve_files(plain(tables), Path()))
        except ValidationError as error:
            raise UsageError(explain(error)) from None

    def start(self, out: str | PathLike[str] | None = None, *, in_process: bool = False) -> "LiveRun":
        """Start a run of it that a script steers; results go into the folder ``out``, by default runs/NAME-TIME.

        It waits at the beginning until the script lets it go: see ``testbed.orchestrator.live``, which is loaded here
        by its name, as a scenario knows nothing of how it is run. ``in_process``: everything in this process, without
        zenoh. Raises UsageError where the scenario cannot run, RunFailed where the roles do not start.
        """
        run: LiveRun = import_module("testbed.orchestrator.live").start(self, out, in_process=in_process)
        return run

    @field_validator("uncertainty")
    @classmethod
    def _check_uncertainty(cls, uncertainty: Uncertainty | None, info: ValidationInfo) -> Uncertainty | None:
        if uncertainty is not None and "system" in info.data:
            uncertainty.check_sizes(info.data["system"])
        return uncertainty

    @field_validator("estimators")
    @classmethod
    def _check_parts(cls, specs: tuple[EstimatorSpec, ...], info: ValidationInfo) -> tuple[EstimatorSpec, ...]:
        names: set[str] = set()
        for i, spec in enumerate(specs):
            if spec.name in names:
                raise problem(f"got {spec.name!r} a second time; allowed: a name of its own", f"[{i}].name")
            names.add(spec.name)
            steps = info.data.get("steps")
            if spec.until is not None and steps is not None and spec.until > steps:
                raise problem(f"got {spec.until}; allowed: 1 … {steps}, the steps of the scenario", f"[{i}].until")
        return specs

    @field_validator("links")
    @classmethod
    def _check_links(cls, links: Links, info: ValidationInfo) -> Links:
        clock: Clock | None = info.data.get("clock")
        if clock is not None:
            _check_times(links, clock)
        observation = links.observation
        if observation.on_loss == "noise" and observation.takes_time:
            raise problem(
                "got 'noise' on a link with a delay, rate, order, copies, bit errors, a transport, a clock of its own "
                "or a real backend; "
                "allowed there: nothing",
                "observation.on_loss",
            )
        if clock is None or "steps" not in info.data:
            return links
        return links.of_run(info.data["steps"], clock.period_ns)

    @field_validator("events")
    @classmethod
    def _check_events(cls, events: tuple[Event, ...], info: ValidationInfo) -> tuple[Event, ...]:
        around = Surroundings.of(info.data)
        if around is not None:
            check_events(events, around)
        if {"estimators", "input", "clock", "steps"} <= info.data.keys():
            source: Input | None = info.data["input"]
            _planned(events, info.data["estimators"], source, info.data["clock"], info.data["steps"])
        return events

    @property
    def swaps(self) -> list[Planned]:
        """The events of estimators, resolved, in the order of time."""
        return _planned(self.events, self.estimators, self.input, self.clock, self.steps)

    def changes_of(self, link: str) -> list[tuple[int, dict[str, Any]]]:
        """(step, keys with their new values) of a link's events whose step is known, in the order of time."""
        return list(changes_in(self.links, self.timed(LinkEvent, PartitionEvent, HealEvent)).get(link, []))

    def timed(self, *kinds: type[E]) -> list[tuple[int, E]]:
        """The events of some kinds whose step is known, with it, in the order of time."""
        found = [(e.step(self.clock.period_ns), e) for e in self.events if isinstance(e, kinds) and e.timed]
        return sorted(found, key=lambda entry: entry[0])

    @property
    def drift(self) -> list[tuple[int, PlantEvent]]:
        """The changes of the plant whose step is known, with it, in the order of time."""
        return self.timed(PlantEvent)

    @property
    def waits(self) -> bool:
        """Whether an event waits for a condition."""
        return any(not event.timed for event in self.events)

    def variants(self, link: str) -> list[SteppedImpairments]:
        """The link of that name at the beginning, and after each of its events."""
        return in_turn(getattr(self.links, link), [change for _, change in self.changes_of(link)])

    @field_validator("actuator")
    @classmethod
    def _check_actuator(cls, actuator: Actuator, info: ValidationInfo) -> Actuator:
        system: System | None = info.data.get("system")
        if actuator.on_loss == "hold" and system is not None and system.B is None:
            raise problem("got 'hold', but system.B is not given; allowed: zero, or hold with system.B", "on_loss")
        return actuator

    def takes_time(self, link: str) -> bool:
        """Whether the link of that name takes time, at the beginning or after an event, or carries ACKs in batches."""
        settings = getattr(self.links, link)
        batched = isinstance(settings, AckLink) and settings.batch > 1
        waiting = [e.set for e in self.events if isinstance(e, LinkEvent) and e.link == link and not e.timed]
        variants = [*self.variants(link), *(changed(settings, table) for table in waiting)]
        return batched or any(variant.takes_time for variant in variants)

    @field_validator("input")
    @classmethod
    def _check_input(cls, source: Input | None, info: ValidationInfo) -> Input | None:
        system: System | None = info.data.get("system")
        if system is None:
            return source
        if source is None:
            return _no_input(info.data)
        if system.B is None:
            raise problem(f"got kind {source.kind!r}, but system.B is not given; allowed: [input] only with system.B")
        check_channels(source, system)
        if isinstance(source, TableInput) and len(source.values) < info.data.get("steps", 0):
            steps = info.data["steps"]
            raise problem(
                f"got {count(len(source.values), 'row')}; allowed: at least {steps}, one for each step", "values"
            )
        if isinstance(source, ClosedLoop):
            return _closed_loop(source, info)
        return source

    @field_validator("cost")
    @classmethod
    def _check_cost(cls, cost: Cost | None, info: ValidationInfo) -> Cost | None:
        system: System | None = info.data.get("system")
        if cost is not None and system is not None:
            cost.check_sizes(system)
        return cost


def _check_times(links: Links, clock: Clock) -> None:
    """A problem of validation where a deadline or a slot does not fit the period."""
    least_ns = -(-clock.period_ns // SLOTS_A_PERIOD)
    for name in Links.model_fields:
        link: SteppedImpairments = getattr(links, name)
        if link.deadline_ns(clock.period_ns) > clock.period_ns:
            raise problem(f"got {link.deadline!r}; allowed: at most the period, {clock.period!r}", f"{name}.deadline")
        if link.slot is not None and parse_duration(link.slot) < least_ns:
            least = format_duration(least_ns)
            raise problem(
                f"got {link.slot!r}; allowed: {least!r} or more, with the period {clock.period!r}", f"{name}.slot"
            )


def _planned(
    events: Sequence[Event], specs: Sequence[EstimatorSpec], source: Input | None, clock: Clock, steps: int
) -> list[Planned]:
    """The events of estimators in the order of time; a problem of validation where one does not fit."""
    followed = source.estimator if isinstance(source, ClosedLoop) else None
    places = [i for i, event in enumerate(events) if isinstance(event, ESTIMATOR_EVENTS) and event.timed]
    timed: list[tuple[EstimatorEvent, int]] = []
    for i in places:
        event = events[i]
        assert isinstance(event, ESTIMATOR_EVENTS)
        timed.append((event, event.step(clock.period_ns)))
    return planned(specs, timed, steps=steps, followed=followed, places=places)


def _closed_loop(source: Following, info: ValidationInfo) -> Following:
    """`source` checked against the rest of the scenario, with the name of its estimator."""
    if "estimators" not in info.data or "steps" not in info.data:
        return source
    specs: tuple[EstimatorSpec, ...] = info.data["estimators"]
    if not specs:
        raise problem(
            f"got no [[estimators]]; allowed: {source.kind} only through an estimator of the scenario", "estimator"
        )
    names = [spec.name for spec in specs]
    name = source.estimator or names[0]
    if name not in names:
        hint = did_you_mean(name, names)
        raise problem(f"got {shown(name)}; allowed: {', '.join(names)}{hint}", "estimator")
    until, steps = specs[names.index(name)].until, info.data["steps"]
    if until is not None and until < steps:
        raise problem(f"got {name!r}, which ends at step {until}; allowed: one that runs to step {steps}", "estimator")
    return source.model_copy(update={"estimator": name})
