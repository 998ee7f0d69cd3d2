"""When each part of each step was published and arrived, against the wall clock. No I/O."""

from __future__ import annotations

from dataclasses import dataclass, field

from testbed.channel.service import role_of as link_role
from testbed.control.service import ROLE as CONTROLLER
from testbed.estimator.service import role_of as estimator_role
from testbed.orchestrator.realtime_figures import Quantiles, RealTime, Stage, quantiles
from testbed.plant.service import ROLE as PLANT
from testbed.scenario import Scenario

NEVER = -(2**62)


@dataclass
class StageTimes:
    """One stage of the way of a step. Lists are by step, k = 1 first, of the last packet of the step.

    role: who publishes. before: the stage that it follows from. last: the last step that it has.
    """

    role: str
    before: str | None
    what: str
    last: int
    packets: int
    published: list[int] = field(default_factory=list)
    arrived: list[int] = field(default_factory=list)
    come: dict[int, int] = field(default_factory=dict)
    whole: int = 0
    """Steps of which all packets have come, in order, and those before the first that it has."""
    missed: int = 0
    first_missed: int | None = None

    def note(self, step: int, published_ns: int, arrived_ns: int) -> bool:
        """Take one packet; whether it was the last of its step."""
        while len(self.published) < step:
            self.published.append(NEVER)
            self.arrived.append(NEVER)
        self.published[step - 1] = max(self.published[step - 1], published_ns)
        self.arrived[step - 1] = max(self.arrived[step - 1], arrived_ns)
        come = self.come.pop(step, 0) + 1
        if come < self.packets:
            self.come[step] = come
            return False
        self.whole += 1
        return True


class Punctuality:
    """The times of a run, all relative to t_k = start + (k − 1) periods, when u_{k−1} was due, in nanoseconds.

    A stage has missed the deadline of step k if the last of its packets of that step was published after t_k + the
    deadline of the scenario.
    """

    def __init__(self, scenario: Scenario, blocks: int) -> None:
        self.start_ns = 0
        """The date at which u_0 is due."""
        self.outstanding_max = 0
        self._clock, self._steps, self._blocks = scenario.clock, scenario.steps, blocks
        self.stages: dict[str, StageTimes] = {}

        def add(topic: str, role: str, before: str | None, what: str, last: int = scenario.steps) -> None:
            self.stages[topic] = StageTimes(role, before, what, last, blocks)

        add("control/sent", CONTROLLER, None, "control")
        add("control/delivered", link_role("control"), "control/sent", "control")
        add("observation/sent", PLANT, "control/delivered", "observation")
        add("observation/delivered", link_role("observation"), "observation/sent", "observation")
        if scenario.links.ack.mode == "link":
            add("ack/delivered", link_role("ack"), "control/delivered", "ACK")
        for spec in scenario.estimators:
            last = spec.until or scenario.steps
            add(f"estimate/{spec.name}", estimator_role(spec.name), "observation/delivered", "estimate", last)

    def serve(self, name: str, role: str, first: int, last: int) -> None:
        """From step ``first`` on a role gives the estimates of a name, which may be new."""
        topic = f"estimate/{name}"
        stage = self.stages.get(topic)
        if stage is None:
            stage = StageTimes(role, "observation/delivered", "estimate", last, self._blocks, whole=first - 1)
            self.stages[topic] = stage
        stage.role, stage.last = role, last

    def forget(self, name: str) -> None:
        """A name that was to have estimates has none."""
        self.stages.pop(f"estimate/{name}", None)

    def ends(self, name: str, last: int) -> None:
        """There are no estimates of a name after step ``last``."""
        self.stages[f"estimate/{name}"].last = last

    def after(self, name: str, step: int, count: int) -> tuple[float | None, int]:
        """Of so many estimates of a name from ``step`` on: the largest lateness after t_k, in ms, and how many missed.

        None where none of them has come.
        """
        times = self.stages[f"estimate/{name}"].published[step - 1 : step - 1 + count]
        come = [ns for ns in times if ns != NEVER]
        return max(come) / 1e6 if come else None, sum(ns > self._clock.deadline_ns for ns in come)

    def due(self, now_ns: int) -> int:
        """Steps whose control was due by a date."""
        if now_ns < self.start_ns:
            return 0
        return min(self._steps, (now_ns - self.start_ns) // self._clock.period_ns + 1)

    def note(self, topic: str, index: int, published_ns: int, arrived_ns: int) -> str | None:
        """Take a packet's dates; index: its ``step``. What to say if with it a deadline was missed."""
        stage = self.stages.get(topic)
        if stage is None:
            return None
        step = index + 1 if topic.startswith("control/") else index
        begun = self.start_ns + (step - 1) * self._clock.period_ns
        if not stage.note(step, published_ns - begun, arrived_ns - begun):
            return None
        late = stage.published[step - 1] - self._clock.deadline_ns
        if late <= 0:
            return None
        stage.missed += 1
        if stage.first_missed is None:
            stage.first_missed = step
        return f"{stage.role} missed the deadline of step {step}: {stage.what} published {late / 1e6:.3g} ms after it"

    def absent(self, now_ns: int, patience_ns: int) -> str | None:
        """What to say where something has still not come so long after the deadline of its step."""
        over = self.due(now_ns - self._clock.deadline_ns - patience_ns)
        late = [stage for stage in self.stages.values() if stage.whole < min(over, stage.last)]
        if not late:
            return None
        first = min(late, key=lambda stage: stage.whole)
        past = now_ns - self.start_ns - first.whole * self._clock.period_ns - self._clock.deadline_ns
        return (
            f"{first.role} missed the deadline of step {first.whole + 1}: no {first.what} {past / 1e6:.3g} ms after it"
        )

    def figures(self, due: int, steps: int, **more: object) -> RealTime:
        """due: steps whose deadline was over when the run ended. steps: those of which the summary has figures."""
        out = {}
        for topic, stage in self.stages.items():
            before = self.stages[stage.before].published if stage.before else [0] * len(stage.published)
            both = zip(stage.published, before, strict=False)
            out[topic] = Stage(
                role=stage.role,
                published=_known(stage.published),
                arrived=_known(stage.arrived),
                hop=quantiles([a - b for a, b in both if NEVER not in (a, b)]),
                missed=stage.missed,
                first_missed=stage.first_missed,
                absent=max(0, min(due, stage.last) - stage.whole),
                published_us=tuple(
                    None if ns == NEVER else ns / 1e3
                    for ns in (stage.published + [NEVER] * (steps - len(stage.published)))[:steps]
                ),
            )
        return RealTime.model_validate(
            {
                "start_ns": self.start_ns,
                "period_us": self._clock.period_ns / 1e3,
                "deadline_us": self._clock.deadline_ns / 1e3,
                "deadlines": self._clock.deadlines or "soft",
                "outstanding_max": self.outstanding_max,
                "stages": out,
                **more,
            }
        )


def _known(values: list[int]) -> Quantiles:
    return quantiles([value for value in values if value != NEVER])
