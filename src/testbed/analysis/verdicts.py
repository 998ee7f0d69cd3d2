"""What the theorems say of one scenario: stable, unstable or not decided, and by which theorem."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np

from testbed.analysis.bursts import delivered_run, lost_run, run_law
from testbed.analysis.convergence import Knowledge, convergence, settled
from testbed.analysis.critical import CriticalArrival, critical_arrival, observed_at_once, recovery_threshold
from testbed.analysis.moments import finite_moment_order, spectral_radius
from testbed.analysis.peak import burst_series, condition_two, failure_limit, growth_factors, scalar_peak_is_stable
from testbed.analysis.robust_verdicts import robust_figures
from testbed.analysis.strong import StrongObservability, strong_observability
from testbed.analysis.structure import Reach, controllability, observability, unstable_eigenvalues
from testbed.channel.hidden import Hidden
from testbed.channel.in_time import law_of_link
from testbed.channel.law import LossModel
from testbed.channel.loss import Chain
from testbed.estimator.bounds import held_factor
from testbed.estimator.buffers import largest_buffer
from testbed.numerics.lanes import Floats
from testbed.scenario import ClosedLoop, Input, Links, Loss, Scenario

_AT_THRESHOLD = 1e-9
"""Relative distance below which a rate counts as equal to its threshold; no theorem decides there."""


@dataclass(frozen=True)
class Verdict:
    """``stable``: True, False, or None for not decided; the theorem that says so, and why it applies or does not."""

    stable: bool | None
    theorem: str
    reason: str

    def table(self) -> dict[str, Any]:
        return {"stable": self.stable, "theorem": self.theorem, "reason": self.reason}


@dataclass(frozen=True)
class Facts:
    """What the verdicts need of a system: A (n, n), C (p, n), Q (n, n) and what was found out about them."""

    A: Floats
    C: Floats
    Q: Floats
    radius: float
    controllable: Reach
    observable: Reach
    strong: StrongObservability
    critical: CriticalArrival

    @classmethod
    def of(cls, A: Floats, C: Floats, Q: Floats) -> Facts:
        """Q (n, n): the covariance of the process noise as it enters the state, G Q G'."""
        return cls(
            A,
            C,
            Q,
            spectral_radius(A),
            controllability(A, Q),
            observability(A, C),
            strong_observability(A, C),
            critical_arrival(A, C),
        )

    @property
    def noise_feeds_growth(self) -> bool:
        """Whether the noise reaches every eigenvalue outside the open unit disc."""
        return self.controllable.stable_rest

    def growth(self, losses: LossModel) -> float:
        """ρ² θ: what a burst grows by, times the factor by which longer ones are rarer; maybe infinite.

        θ = 1 − recovery for a chain of arrivals.
        """
        return self.radius * self.radius * losses.burst_decay if losses.burst_decay > 0.0 else 0.0

    @property
    def strongly_built(self) -> bool:
        """M Assumptions 1, but for the chain (controllable, observable), and 2."""
        return self.controllable.full and self.observable.full and self.strong.holds

    def strongly(self, chain: Chain) -> bool:
        """Whether M Theorem 5 applies: M Assumptions 1 (controllable, observable, the chain irreducible) and 2."""
        return self.strongly_built and chain.recovery > 0.0 and chain.failure > 0.0

    @property
    def scalar(self) -> bool:
        """Whether P Theorem 8 applies: n = p = 1, c ≠ 0, Q > 0."""
        return self.A.shape == (1, 1) == self.C.shape and self.observable.full and self.controllable.full


def analyze(scenario: Scenario) -> dict[str, Any]:
    """All that is said of a scenario, as tables, lists, texts, numbers and None; the keys are those of the command."""
    system = scenario.system
    A, C, Q = np.array(system.A), np.array(system.C), np.array(system.Q)
    if system.G is not None:
        G = np.array(system.G)
        Q = G @ Q @ G.T
    with np.errstate(all="ignore"):  # what overflows is infinite, and infinite is taken care of
        figures: dict[str, Any] = _plain(_figures(scenario, Facts.of(A, C, Q)))
    return figures


def _figures(scenario: Scenario, facts: Facts) -> dict[str, Any]:
    A = facts.A
    observed, controlled = scenario.links.observation.loss, scenario.links.control.loss
    chain = _simplest(law_of_link(scenario, "observation", largest_buffer(scenario)))
    in_time = law_of_link(scenario, "control")
    control = _simplest(in_time)
    verdict = observation_verdict(facts, chain)
    return {
        "name": scenario.name,
        "spectral_radius": facts.radius,
        "unstable_eigenvalues": [_pair(value) for value in unstable_eigenvalues(A)],
        "controllable": facts.controllable.full,
        "uncontrollable_eigenvalues": [_pair(value) for value in facts.controllable.failing],
        "observable": facts.observable.full,
        "unobservable_eigenvalues": [_pair(value) for value in facts.observable.failing],
        "observability_index": facts.observable.index if facts.observable.full else None,
        "strongly_observable": {
            "holds": facts.strong.holds,
            "reason": facts.strong.reason,
            "failing": [_pair(value) for value in facts.strong.failing],
        },
        "critical_arrival": {
            "lower": facts.critical.lower,
            "upper": facts.critical.upper,
            "exact": facts.critical.exact,
            "reason": facts.critical.reason,
        },
        "critical_recovery": recovery_threshold(A),
        "observation": {**_link(observed, chain), **verdict.table()},
        "control": {
            **_link(controlled, control),
            **_control(scenario, verdict, control).table(),
        },
        "bounds": {
            "lower": Verdict(verdict.stable, verdict.theorem, f"covariance with every ACK: {verdict.reason}").table(),
            "upper": _upper_bound(scenario, verdict, control).table(),
        },
        "peak": peak_figures(facts, chain),
        "moments": moment_figures(facts, chain, verdict),
        "convergence": convergence(
            facts.observable,
            facts.controllable,
            settled(A, facts.C, facts.Q, np.array(scenario.system.R)),
            Knowledge(
                chain,
                in_time,
                scenario.links.ack.mode == "perfect",
                scenario.actuator.on_loss == "hold",
            ),
            scenario.input,
        ),
        "robust": robust_figures(scenario),
    }


def _control(scenario: Scenario, observation: Verdict, control: LossModel) -> Verdict:
    if scenario.actuator.on_loss == "hold":
        return held_control_verdict(observation, control, scenario.input, scenario.links)
    return control_verdict(observation, control, scenario.input, scenario.links)


def _upper_bound(scenario: Scenario, observation: Verdict, control: LossModel) -> Verdict:
    if scenario.actuator.on_loss == "hold" and not control.never_loses:
        return held_bound_verdict(observation, control, scenario.input)
    return upper_bound_verdict(observation, scenario.input)


def _simplest(losses: LossModel) -> LossModel:
    """The chain of arrivals that the losses are, if they are one: then the theorems for chains hold."""
    return losses.as_chain or losses


def observation_verdict(facts: Facts, chain: LossModel) -> Verdict:
    """Whether the expected covariance with every ACK stays bounded, for the observation link ``chain``."""
    if facts.radius < 1.0:
        return Verdict(True, "ρ(A) < 1", "the covariance stays bounded without any observation")
    if not facts.observable.stable_rest:
        listed = "an eigenvalue on or outside the unit circle is not observed"
        if not facts.noise_feeds_growth:
            return Verdict(None, "none", f"{listed}, and the noise does not reach all that grows")
        return Verdict(False, "detectability", f"{listed}: no link helps")
    if chain.never_loses:
        if facts.noise_feeds_growth:
            return Verdict(True, "Kalman filter", "(A, C) is detectable and nothing is lost")
        return Verdict(None, "none", "no losses, but the noise does not reach all that grows")
    if not facts.noise_feeds_growth:
        return Verdict(None, "none", "(A, sqrt Q) is not stabilisable: no theorem here applies")
    if isinstance(chain, Hidden):
        return hidden_verdict(facts, chain)
    threshold = recovery_threshold(facts.A)
    growth = f"ρ²(1 − recovery) = {facts.growth(chain):.6g}"
    if threshold == 0.0 and chain.recovery > 0.0:
        return _marginal(facts, chain)
    if _equal(chain.recovery, threshold):
        return Verdict(None, "none", f"{growth}: at the threshold {threshold:.6g}, which no theorem decides")
    if chain.recovery < threshold:
        general = "Sinopoli lower bound" if chain.independent else "bound 1 − ρ^{-2}"
        theorem = "M Theorem 5" if facts.strongly(chain) else general
        return Verdict(False, theorem, f"{growth} > 1: a burst of losses outgrows its probability")
    below = f"{growth} < 1"
    if facts.strongly(chain):
        return Verdict(True, "M Theorem 5", f"{below}, strongly observable, (A, sqrt Q) controllable")
    if observed_at_once(facts.A, facts.C):
        return Verdict(True, "P Lemma 5", f"{below}, one observation determines the unstable part")
    upper = facts.critical.upper
    if chain.independent and upper is not None and chain.arrival > upper:
        reason = f"arrival {chain.arrival:.6g} > {upper:.6g}, where the modified Riccati equation has a solution"
        return Verdict(True, "Sinopoli upper bound", reason)
    why = "between the two bounds" if chain.independent else "necessary; not strongly observable, so not sufficient"
    return Verdict(None, "none", f"{below}: {why}; {facts.strong.reason}")


def hidden_verdict(facts: Facts, losses: Hidden) -> Verdict:
    """The same for a hidden chain behind the arrivals, where the system is detectable and the noise feeds its growth.

    Necessary: E[P̄_k] ≥ Σ_m P(the last m packets lost) A^m Q A'^m, and that probability falls like θ^m. Sufficient: if
    one observation determines the unstable part, that sum with A^m A'^m bounds it from above too. Otherwise the
    arrivals dominate independent ones: P(lost | past) is at most ``worst_loss`` in the end, and P is monotone in γ, so
    that what holds for independent losses of more than that rate holds here.
    """
    theta, worst, threshold = losses.burst_decay, losses.worst_loss, recovery_threshold(facts.A)
    growth = f"ρ²θ = {facts.growth(losses):.6g}"
    if _equal(theta, 1.0 - threshold):
        return Verdict(None, "none", f"{growth}: at the threshold θ = {1.0 - threshold:.6g}, which is not decided")
    if theta > 1.0 - threshold:
        return Verdict(False, "bursts", f"{growth} > 1: a burst of losses outgrows its probability")
    if observed_at_once(facts.A, facts.C):
        return Verdict(True, "bursts", f"{growth} < 1, one observation determines the unstable part")
    arrival = f"arrivals dominate independent ones of rate {1.0 - worst:.6g}"
    if facts.strongly_built and worst < 1.0 - threshold and not _equal(worst, 1.0 - threshold):
        return Verdict(True, "domination, M Theorem 5", f"{arrival} > {threshold:.6g}, strongly observable")
    upper = facts.critical.upper
    if upper is not None and 1.0 - worst > upper and not _equal(1.0 - worst, upper):
        return Verdict(True, "domination, Sinopoli upper bound", f"{arrival} > {upper:.6g}")
    return Verdict(None, "none", f"{growth} < 1: necessary, not known to be sufficient; {facts.strong.reason}")


def control_verdict(observation: Verdict, chain: LossModel, source: Input | None, links: Links) -> Verdict:
    """Whether losses of controls leave the expected covariance of OE and AOE bounded (D Theorem 2, M Theorem 4)."""
    if source is None or chain.never_loses or links.ack.mode == "perfect":
        known = "there is no input" if source is None else "the fate of every control packet is known"
        return Verdict(observation.stable, "separation", f"{known}: as with the observation link alone")
    theorem = "D Theorem 2" if chain.independent else "M Theorem 4"
    if isinstance(chain, Hidden):
        theorem = "S, correlated"
        if chain.covariance_factor is None:
            return Verdict(
                False if observation.stable is False else None, theorem, "the states alternate: S is not bounded"
            )
    if isinstance(source, ClosedLoop):
        return Verdict(
            False if observation.stable is False else None, theorem, "u is fed back, so that its bound is not known"
        )
    return Verdict(
        observation.stable, theorem, "u is bounded: control losses change the covariance, not whether it is bounded"
    )


def held_control_verdict(observation: Verdict, chain: LossModel, source: Input | None, links: Links) -> Verdict:
    """The same with an actuator that holds: by S of held inputs, which the papers do not have."""
    if source is None or chain.never_loses or links.ack.mode == "perfect":
        return control_verdict(observation, chain, source, links)
    bound = held_bound_verdict(observation, chain, source)
    if bound.stable is None or bound.stable is not observation.stable:
        return Verdict(False if observation.stable is False else None, bound.theorem, bound.reason)
    reason = "u is bounded, and so is what is held: control losses change the covariance, not whether it is bounded"
    return Verdict(observation.stable, bound.theorem, reason)


def held_bound_verdict(observation: Verdict, chain: LossModel, source: Input | None) -> Verdict:
    """S with an actuator that holds (see estimator.bounds): for i.i.d. control losses."""
    theorem, factor = "S, held inputs", held_factor(chain)
    if isinstance(source, ClosedLoop):
        return Verdict(None, theorem, "u is fed back: no bound of what is held is known")
    if factor is None:
        return Verdict(None, theorem, "the actuator holds, and a bound is known for i.i.d. control losses only")
    return Verdict(observation.stable, theorem, f"the recursion with every ACK, and {factor:.6g} · ¼ U more noise")


def upper_bound_verdict(observation: Verdict, source: Input | None) -> Verdict:
    """The bound S of M Theorem 3: the recursion with every ACK, with ¼ U added to Q."""
    if isinstance(source, ClosedLoop):
        return Verdict(None, "M Theorem 3", "u is fed back: no U ≥ B u u' B' is known")
    return Verdict(observation.stable, "M Theorem 3", "the recursion with every ACK, and ¼ U more noise")


def peak_figures(facts: Facts, chain: LossModel) -> dict[str, Any]:
    """P Theorem 6, and Theorem 8 for scalar systems."""
    out: dict[str, Any] = dict.fromkeys(("condition_i", "condition_ii", "left_side", "d", "series", "series_tail"))
    out |= {"failure_max": None, "critical_recovery": recovery_threshold(facts.A)}
    if isinstance(chain, Hidden):
        return {**out, **Verdict(None, "none", "P is for Markov arrivals, and these have a hidden state").table()}
    if not facts.observable.full:
        return {**out, **Verdict(None, "P Theorem 6", "(A, C) is not observable").table()}
    index, condition_i = facts.observable.index, facts.growth(chain) < 1.0
    d = growth_factors(facts.A, index)
    out |= {"condition_i": condition_i, "d": list(d)}
    series = burst_series(facts.A, chain.recovery) if condition_i and math.isfinite(max(d)) else None
    if series is not None:
        left = condition_two(d, index, series.value + series.tail, chain.recovery, chain.failure)
        out |= {"series": series.value, "series_tail": series.tail, "left_side": left, "condition_ii": left < 1.0}
        out["failure_max"] = failure_limit(d, index, series.value + series.tail, chain.recovery)
    elif condition_i and index == 1:
        out |= {"left_side": 0.0, "condition_ii": True, "failure_max": 1.0}
    return {**out, **_peak_verdict(facts, chain, condition_i, out["condition_ii"]).table()}


def _peak_verdict(facts: Facts, chain: Chain, first: bool, second: bool | None) -> Verdict:
    if not (0.0 < chain.failure < 1.0 and 0.0 < chain.recovery < 1.0):
        return Verdict(None, "P Theorem 6", "recovery and failure are not both inside 0 … 1")
    growth = f"ρ²(1 − recovery) = {facts.growth(chain):.6g}"
    if facts.scalar:
        stable = scalar_peak_is_stable(float(facts.A[0, 0]), chain.recovery)
        return Verdict(stable, "P Theorem 8", f"{growth}: {'< 1' if stable else 'not < 1'}, necessary and sufficient")
    if first and second:
        name = "P Corollary 7" if facts.observable.index == 1 else "P Theorem 6"
        return Verdict(True, name, f"{growth} < 1, and condition (ii) holds")
    if not first:
        return Verdict(None, "P Theorem 6", f"{growth}: condition (i) fails; it is sufficient only")
    return Verdict(None, "P Theorem 6", "condition (ii) is not known to hold; it is sufficient only")


def moment_figures(facts: Facts, chain: LossModel, observation: Verdict) -> dict[str, Any]:
    """Order of the finite moments of the covariance (P Corollary 9); None where nothing is decided.

    Necessary in general. Sufficient for scalar systems, and where one observation determines the unstable part.
    """
    order = finite_moment_order(facts.A, chain)
    bounded = facts.radius < 1.0 or (observation.stable is True and chain.never_loses)
    sufficient = facts.scalar or (
        observation.stable is True and facts.observable.stable_rest and observed_at_once(facts.A, facts.C)
    )

    def finite(r: float) -> bool | None:
        if bounded:
            return True
        if observation.stable is False:
            return False
        if order <= r and facts.noise_feeds_growth:
            return False
        return True if sufficient and order > r and facts.radius > 1.0 and chain.burst_decay < 1.0 else None

    return {
        "order": order,
        "finite_mean": observation.stable if finite(1.0) is None else finite(1.0),
        "finite_variance": finite(2.0),
    }


def _marginal(facts: Facts, chain: Chain) -> Verdict:
    """ρ(A) = 1: nothing grows exponentially."""
    if facts.strongly(chain):
        return Verdict(True, "M Theorem 5", "ρ(A) = 1, recovery > 0, strongly observable")
    return Verdict(None, "none", f"ρ(A) = 1, and the premises of M Theorem 5 do not hold: {facts.strong.reason}")


def _equal(a: float, b: float) -> bool:
    return math.isclose(a, b, rel_tol=_AT_THRESHOLD)


def _link(loss: Loss, losses: LossModel) -> dict[str, Any]:
    """The figures of a link's losses; lengths that are infinite, or of what never comes, are None."""
    hidden = isinstance(losses, Hidden)
    bad = run_law(losses, False) if isinstance(losses, Hidden) else lost_run(losses)
    good = run_law(losses, True) if isinstance(losses, Hidden) else delivered_run(losses)
    if losses.never_loses:
        bad = None
    return {
        "kind": loss.kind,
        "recovery": None if hidden else losses.recovery,
        "failure": None if hidden else losses.failure,
        "stationary_loss": 1.0 - losses.arrival,
        "mean_burst": bad.mean if bad is not None else None,
        "burst_99": bad.quantile(0.99) if bad is not None else None,
        "mean_good_run": good.mean if good is not None else None,
        "burst_decay": losses.burst_decay,
        "correlation": losses.correlation,
        "memory": losses.memory,
    }


def _plain(value: Any) -> Any:
    """``value`` with None for every number that is not finite."""
    if isinstance(value, dict):
        return {key: _plain(entry) for key, entry in value.items()}
    if isinstance(value, list):
        return [_plain(entry) for entry in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


def _pair(value: complex) -> list[float]:
    return [value.real, value.imag]
