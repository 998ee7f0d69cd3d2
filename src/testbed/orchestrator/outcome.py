"""From what a run collected to its summary: figures, books, checks."""

from __future__ import annotations

import math
import platform
from collections import Counter
from collections.abc import Mapping, Sequence
from importlib.metadata import version
from types import MappingProxyType

import numpy as np

from testbed import __version__
from testbed.analysis.consistency import chi_square_band
from testbed.analysis.moments import finite_moment_order, spectral_radius
from testbed.channel.hidden import Hidden
from testbed.channel.in_time import law_of_link
from testbed.control.optimality import statement
from testbed.control.registry import lqg_gains
from testbed.control.service import ROLE as CONTROLLER
from testbed.estimator.bounds import held_factor
from testbed.estimator.buffers import acks_of, largest_buffer
from testbed.estimator.registry import model_of
from testbed.numerics.lanes import constant
from testbed.orchestrator.conductor import Conductor
from testbed.orchestrator.realtime_figures import RealTime
from testbed.orchestrator.services import Turn
from testbed.orchestrator.summary import (
    Z_95,
    BoundFigures,
    Check,
    ControllerFigures,
    CostFigures,
    EstimatorFigures,
    Happened,
    LinkFigures,
    Summary,
    Timing,
    Transitions,
)
from testbed.orchestrator.transient import with_transients
from testbed.plant.inputs import control_bound
from testbed.scenario import ClosedLoop, FeedbackInput, LqgInput, Scenario
from testbed.wire.messages import Status
from testbed.wire.node import ORCHESTRATOR

_DATE_US = 100.0


def summarise(conductor: Conductor, *, status: str, reason: str | None, timing: Timing) -> Summary:
    """The summary of a run that is over, whole or not."""
    scenario, collector = conductor.setup.scenario, conductor.collector
    links = {
        role.removeprefix("link."): link_figures(report.counters)
        for role, report in sorted(conductor.reports.items())
        if role.startswith("link.") and report.counters
    }
    estimators = _estimators(conductor)
    bounds = _bounds(conductor)
    complete, happened = status == "complete", conductor.happened
    unlike = {e.estimator: e.step for e in reversed(happened) if e.action == "swap" and e.ok and e.handover != "full"}
    moved = drifts_from(happened)
    checks = [*(moment_checks(scenario) if moved is None else drift_checks(moved))]
    checks += between_bounds(scenario, estimators, bounds, unlike)
    checks += rounding(collector.largest_state, estimators)
    pacing = conductor.pacing
    realtime = None if pacing is None else pacing.figures(conductor.reports.get(CONTROLLER))
    if realtime is not None:
        checks += [*date_kept(realtime), *priority_granted(realtime)]
    if complete:
        checks += books(scenario, links, collector.applied)
    rejected = {role: dict(r.rejected) for role, r in sorted(conductor.reports.items()) if r.rejected}
    if conductor.node.rejected:
        rejected[ORCHESTRATOR] = dict(conductor.node.rejected)
    repeated = {role: r.repeated for role, r in sorted(conductor.reports.items()) if r.repeated}
    if conductor.node.repeated:
        repeated[ORCHESTRATOR] = conductor.node.repeated
    broken = next((check.text for check in checks if check.name == "books" and not check.ok), None)
    return Summary.model_validate(
        {
            "name": scenario.name,
            "seed": scenario.seed,
            "steps": scenario.steps,
            "lanes": scenario.lanes,
            "completed_steps": collector.completed,
            "status": "failed" if broken else status,
            "reason": broken or reason,
            "estimators": estimators,
            "bounds": bounds,
            "controller": _controller(conductor),
            "cost": _cost(conductor),
            "links": links,
            "events": with_transients(happened, scenario, conductor.services.turns, estimators),
            "recovered": conductor.recovery.happened,
            "checks": checks,
            "rejected": rejected,
            "repeated": repeated,
            "timing": timing,
            "realtime": realtime,
            "versions": versions(),
        }
    )


def date_kept(realtime: RealTime) -> list[Check]:
    """A finding where the date was set during the run: publications are dated by it, and the pace is not."""
    if abs(realtime.date_set_us) <= _DATE_US:
        return []
    text = (
        f"the date was set by {realtime.date_set_us / 1e3:.3g} ms during the run: the pace was kept, but the times "
        "in `realtime` are wrong by up to that much, and so are the deadlines counted as missed"
    )
    return [Check(name="date", ok=False, text=text)]


def priority_granted(realtime: RealTime) -> list[Check]:
    """Whether the system granted the real-time priority that was asked for."""
    if realtime.priority is None:
        return []
    granted = f"SCHED_FIFO {realtime.priority} for {', '.join(realtime.priorities) or 'no process'}"
    return [Check(name="priority", ok=bool(realtime.priorities), text=granted)]


def link_figures(counters: dict[str, int]) -> LinkFigures:
    """A link's figures from the counters it reported."""
    sent, dropped, bursts = counters["sent"], counters["dropped"], counters["bursts"]
    losses = {"loss": dropped} if dropped else {}
    causes = {key.removeprefix("dropped_"): n for key, n in counters.items() if key.startswith("dropped_") and n}
    transport = {key.removeprefix("transport_"): n for key, n in counters.items() if key.startswith("transport_")}
    return LinkFigures(
        transport=transport,
        sent=sent,
        delivered=counters["delivered"],
        dropped=dropped,
        duplicated=counters.get("duplicated", 0),
        late=counters.get("late", 0),
        in_flight=counters.get("in_flight", 0),
        corrupted=counters.get("corrupted", 0),
        causes=causes or losses,
        real={key.removeprefix("real_"): n for key, n in counters.items() if key.startswith("real_")},
        transitions=Transitions.model_validate({key: counters[key] for key in ("00", "01", "10", "11")}),
        loss_rate=(sent - min(sent, counters["delivered"] + counters.get("in_flight", 0))) / sent if sent else None,
        mean_burst=(counters["00"] + bursts) / bursts if bursts else None,
    )


def drifts_from(happened: Sequence[Happened]) -> int | None:
    """The first step at which the plant is not that of the model any more; None where it always is."""
    return min((event.step for event in happened if event.action == "plant" and event.ok), default=None)


def drift_checks(first: int) -> list[Check]:
    """What stands in place of statements on the long run, where the plant leaves its model."""
    text = (
        f"skipped: from step {first} on the plant is not the model of the estimators, so that nothing is known of the "
        "long run, and errors beyond what they claim are the effect of the drift"
    )
    return [Check(name="finite mean", ok=True, text=text)]


def moment_checks(scenario: Scenario) -> list[Check]:
    """Whether the EEC and the variance of its sample mean can be finite."""
    A, losses = np.array(scenario.system.A), law_of_link(scenario, "observation", largest_buffer(scenario))
    order, rho, decay = finite_moment_order(A, losses), spectral_radius(A), losses.burst_decay
    hidden = isinstance(losses, Hidden)
    burst = f"θ = {decay:.6g}" if hidden else f"P(arrival after a loss) = {losses.recovery:.6g}"
    where, factor = f"ρ(A) = {rho:.6g}, {burst}", "θ" if hidden else "(1 − recovery)"
    growth = rho * rho  # a power would raise where this is infinite
    mean = f"ρ²{factor} = {growth * decay:.4g}"
    variance = f"ρ⁴{factor} = {growth * growth * decay:.4g}"
    if order <= 1.0:
        return [Check(name="finite mean", ok=False, text=f"{where}: {mean} ≥ 1, the EEC diverges")]
    checks = [Check(name="finite mean", ok=True, text=f"{where}: {mean} < 1, necessary for a bounded EEC")]
    if order <= 2.0:
        text = (
            f"{where}: {variance} ≥ 1, the error covariance has no finite variance in the long run"
            f"{'' if hidden else ' (P Corollary 9)'}: "
            "standard errors and confidence bands of its mean are not to be trusted, more lanes do not mend that"
        )
        return [*checks, Check(name="finite variance", ok=False, text=text)]
    return [*checks, Check(name="finite variance", ok=True, text=f"{where}: {variance} < 1")]


def books(scenario: Scenario, links: dict[str, LinkFigures], applied: int) -> list[Check]:
    """Every packet is accounted for: sent = delivered + dropped, and the plant applied what was delivered."""
    total = scenario.lanes * scenario.steps
    wrong = []
    for name, link in links.items():
        if link.sent != total:
            wrong.append(f"link {name}: {link.sent} lane-packets sent, {total} expected")
        if link.delivered + link.dropped + link.in_flight != link.sent + link.duplicated:
            wrong.append(f"link {name}: delivered and dropped do not add up to {link.sent + link.duplicated}")
    for name in ("control", "observation"):
        if name not in links:
            wrong.append(f"link {name} did not report")
    if "control" in links and links["control"].delivered != applied:
        wrong.append(f"link control delivered {links['control'].delivered}, the plant applied {applied}")
    text = f"{total} lane-packets a link: sent = delivered + dropped, delivered = applied"
    if any(link.in_flight or link.duplicated for link in links.values()):
        text = text.replace("sent = delivered + dropped", "sent + copies = delivered + dropped + in flight")
    return [Check(name="books", ok=not wrong, text="; ".join(wrong) or text)]


def rounding(largest_state: list[float], estimators: dict[str, EstimatorFigures]) -> list[Check]:
    """Whether the state stays small enough for its error to be seen: x − x̂ is known to about |x| 2^-52 at best.

    A finding only where rounding passes a thousandth of sqrt(tr P).
    """
    for k, largest in enumerate(largest_state):
        traces = [figures.trace_P_mean[k] for figures in estimators.values()]
        smallest = min((trace for trace in traces if trace is not None), default=None)
        if smallest is not None and largest * 2.0**-52 > 1e-3 * math.sqrt(smallest):
            text = (
                f"from step {k + 1} on the state (up to {largest:.2g}) is so large that rounding blurs its error "
                f"(sqrt tr P = {math.sqrt(smallest):.2g}): squared error and NEES there mean nothing; "
                "use fewer steps, or a closed loop"
            )
            return [Check(name="rounding", ok=False, text=text)]
    return []


def between_bounds(
    scenario: Scenario,
    estimators: dict[str, EstimatorFigures],
    bounds: BoundFigures | None,
    unlike: Mapping[str | None, int] = MappingProxyType({}),
) -> list[Check]:
    """Whether the mean of tr P lies between the means of the bounds, for the estimators of M Theorem 3.

    The lower bound holds in every lane. The upper one holds in expectation, so that the mean may exceed it by three
    standard errors, and one lane says nothing. M's proof covers i.i.d. control losses; the bound taken is one that
    holds for those of the run. With an actuator that holds it is one for OE alone.

    unlike: the step from which on an estimator is not one that has run from the beginning.
    """
    checks = []
    for name, figures in estimators.items():
        if bounds is None or figures.kind not in ("aoe", "oe") or figures.since > 1:
            continue
        own = figures.trace_P_mean[: unlike.get(name, scenario.steps + 1) - 1]
        steps = [k for k, mean in enumerate(own) if mean is not None]
        upper, symbol = valid_upper(bounds)
        slack = [3.0 * (e or 0.0) for e in figures.trace_P_stderr]
        if scenario.lanes == 1 or (figures.kind == "aoe" and model_of(scenario).holds):
            upper, symbol = (None,) * len(bounds.lower_mean), ""
        inside = sum(
            _at_most(bounds.lower_mean[k], figures.trace_P_mean[k])
            and _at_most(figures.trace_P_mean[k], upper[k], slack[k])
            for k in steps
        )
        what = f"between Pᴬ and {symbol}" if symbol else "above Pᴬ"
        text = f"mean tr P {what} at {inside} of {len(steps)} steps"
        checks.append(Check(name=f"{name} within bounds", ok=inside == len(steps), text=text))
    return checks


def valid_upper(bounds: BoundFigures) -> tuple[tuple[float | None, ...], str]:
    """The upper bound that holds for the control losses, and its name; Nones and "" where none does."""
    upper = bounds.valid_upper_mean
    if upper is None:
        return (None,) * len(bounds.lower_mean), ""
    return upper, "S" if bounds.upper_correlated_mean is None else "S with room for correlated control losses"


def versions() -> dict[str, str]:
    names = {"numpy": "numpy", "scipy": "scipy", "pydantic": "pydantic", "zenoh": "eclipse-zenoh"}
    found = {name: version(distribution) for name, distribution in names.items()}
    return {"testbed": __version__, "python": platform.python_version(), **found}


def _at_most(a: float | None, b: float | None, slack: float = 0.0) -> bool:
    return a is None or b is None or a <= b * (1 + 1e-9) + slack


def _estimators(conductor: Conductor) -> dict[str, EstimatorFigures]:
    scenario = conductor.setup.scenario
    out = {}
    services = conductor.services
    for name, turns in services.turns.items():
        spec, last = turns[0].spec, services.last[name]
        series = conductor.collector.estimators[name]
        figures = {f"{key}_mean": values for key, values in series.mean.items()}
        figures |= {f"{key}_stderr": values for key, values in series.stderr.items()}
        out[name] = EstimatorFigures.model_validate(
            {
                "kind": spec.kind,
                "acks": acks_of(scenario, spec),
                "since": turns[0].first,
                "until": last if last < scenario.steps else spec.until,
                "nees_band_95": chi_square_band(scenario.system.n, scenario.lanes),
                "undefined": series.undefined,
                "counters": _counters(name, services.turns, conductor.reports),
                **figures,
            }
        )
    return out


def _counters(name: str, services: Mapping[str, Sequence[Turn]], reports: Mapping[str, Status]) -> dict[str, int]:
    """Of all services of a name; one that took over the whole state goes on with the counters of the one before.

    Those of a service that was promoted count under its last name.
    """
    total: Counter[str] = Counter()
    elsewhere = {turn.role: of for of, turns in services.items() for turn in turns[1:] if of != name}
    for turn, after in zip(services[name], [*services[name][1:], None], strict=True):
        if (after is None or not after.carried) and turn.role not in elsewhere:
            total.update(reports.get(turn.role, _SILENT).counters)
    return dict(total)


def _controller(conductor: Conductor) -> ControllerFigures | None:
    scenario, source = conductor.setup.scenario, conductor.setup.scenario.input
    if not isinstance(source, ClosedLoop):
        return None
    gain = source.gain if isinstance(source, FeedbackInput) else None
    if isinstance(source, LqgInput):
        gain = constant(lqg_gains(source, model_of(scenario), scenario.steps)[-1])
    counters = conductor.reports.get(CONTROLLER, _SILENT).counters
    return ControllerFigures(
        kind=source.kind,
        estimator=source.estimator,
        gain=gain,
        statement=_statement(conductor),
        counters={name: n for name, n in counters.items() if not name.startswith("held")},  # those are in `realtime`
    )


def _statement(conductor: Conductor) -> str | None:
    said = statement(conductor.setup.scenario)
    if said is None or drifts_from(conductor.happened) is None or not said.startswith("optimal"):
        return said
    return "not optimal: the plant drifts away from its model"


def _cost(conductor: Conductor) -> CostFigures | None:
    book, steps = conductor.collector.cost, conductor.collector.completed
    if book is None:
        return None
    figures = {f"{key}_mean": values for key, values in book.series.mean.items()}
    figures |= {f"{key}_stderr": values for key, values in book.series.stderr.items()}
    _, total, stderr = book.total()
    interval = None if total is None or stderr is None else (total - Z_95 * stderr, total + Z_95 * stderr)
    return CostFigures.model_validate(
        {
            **figures,
            "total": total,
            "total_stderr": stderr,
            "total_interval_95": interval,
            "a_step": None if total is None else total / steps,
            "a_step_stderr": None if stderr is None else stderr / steps,
        }
    )


def _bounds(conductor: Conductor) -> BoundFigures | None:
    scenario, series = conductor.setup.scenario, conductor.collector.bounds
    if not scenario.bounds:
        return None
    lower = {"lower_mean": series.mean["lower"], "lower_stderr": series.stderr["lower"]}
    if control_bound(scenario) is None:
        no_bound = "the control is feedback, for which no bound is known"
        return BoundFigures.model_validate({**lower, "upper_reason": no_bound})
    model = model_of(scenario)
    if model.holds and held_factor(model.control) is None:
        no_bound = 'with on_loss = "hold" a bound is known for i.i.d. control losses only'
        return BoundFigures.model_validate({**lower, "upper_reason": no_bound})
    upper = {"upper_mean": series.mean["upper"], "upper_stderr": series.stderr["upper"]}
    if any(value is not None for value in series.mean["upper_correlated"]):
        upper["upper_correlated_mean"] = series.mean["upper_correlated"]
        upper["upper_correlated_stderr"] = series.stderr["upper_correlated"]
    reason: str | None = None
    foreign = next(
        (e.step for e in conductor.happened if e.action == "input" and e.ok and not _foreseen(e, scenario)), None
    )
    if foreign is not None:
        reason = f"from step {foreign} on the input is one that the scenario does not have, and U does not cover it"
    if law_of_link(scenario, "control").covariance_factor is None:
        reason = "the control losses never mix, and S holds for independent ones"
    moved = drifts_from(conductor.happened)
    if moved is not None:
        reason = f"the bounds are those of the model, and the plant departs from it at step {moved}"
    if scenario.uncertainty is not None:
        reason = "the bounds are those of the nominal model, and the plant departs from it"
    return BoundFigures.model_validate({**lower, **upper, "upper_reason": reason})


def _foreseen(event: Happened, scenario: Scenario) -> bool:
    """Whether an event of the scenario brought it, so that the bounds know of it."""
    return event.number is not None and event.number < len(scenario.events)


_SILENT = Status(run="00000000", source="none", seq=0, state="stopped")
