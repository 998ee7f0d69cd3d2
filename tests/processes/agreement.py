"""One scenario over each kind of link, and whether the expected error covariances agree.

``PYTHONPATH=src:tests python -m processes.agreement`` prints the tables of docs/how-to/real-links.md.
"""

from __future__ import annotations

import json
import math
import sys
import tempfile
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import tomli_w
from numpy.typing import NDArray

from orchestrator.runs import SYSTEM, recorded
from processes.running import finish, start

Z_95 = 1.96
ARRIVAL = {"control": 0.8, "observation": 0.7}
ESTIMATORS = ("aoe", "ff")


@dataclass(frozen=True)
class Outcome:
    """Of one run. traces: tr P by estimator, (steps, lanes). links: as in summary.json."""

    traces: dict[str, NDArray[np.float64]]
    links: dict[str, Any]
    summary: dict[str, Any]

    def late_mean(self, estimator: str) -> tuple[float, float]:
        """Mean of tr P over the last half of the steps, and its standard error over the lanes."""
        trace = self.traces[estimator]
        by_lane = trace[len(trace) // 2 :].mean(axis=0)
        return float(by_lane.mean()), float(by_lane.std(ddof=1) / math.sqrt(len(by_lane)))

    def loss_z(self, link: str) -> float:
        """Distance of the losses from their mean, in standard deviations of the binomial law."""
        sent, lost, arrival = self.links[link]["sent"], self.lost(link), ARRIVAL[link]
        return float((lost - sent * (1 - arrival)) / math.sqrt(sent * arrival * (1 - arrival)))

    def lost(self, link: str) -> int:
        """Packets that the link lost; not those that came late."""
        return int(self.links[link]["causes"].get("loss", 0))


def tables(*, lanes: int, steps: int, period: str, seed: int, loss: dict[str, Any] | None = None) -> dict[str, Any]:
    """UDP-like: no ACK. Each lane has packets, and fates, of its own. loss: of both links, in place of ARRIVAL.

    FF is for independent losses, and does not take part in others.
    """
    return {
        "name": "agreement",
        "steps": steps,
        "lanes": lanes,
        "seed": seed,
        "record": "all",
        "clock": {"period": period},
        "system": SYSTEM,
        "input": {"kind": "sine", "amplitude": 4.0, "period": 7.0},
        "transport": {"lanes_per_packet": 1},
        "links": {link: {"loss": loss or {"kind": "bernoulli", "arrival": p}} for link, p in ARRIVAL.items()},
        "estimators": [{"name": name} for name in ESTIMATORS if loss is None or name != "ff"],
    }


def run(folder: Path, backend: str, **options: Any) -> Outcome:
    scenario, out = folder / f"{backend}.toml", folder / backend
    scenario.write_text(tomli_w.dumps(tables(**options)))
    code, _, err = finish(start(scenario, out, "--links", backend, "--quiet"))
    assert code == 0, err
    summary = json.loads((out / "summary.json").read_text())
    arrays = recorded(out, options["lanes"], options["steps"])
    traces = {name: np.trace(arrays[f"estimate/{name}"]["P"], axis1=2, axis2=3) for name in summary["estimators"]}
    return Outcome(traces, summary["links"], summary)


def z_late(one: Outcome, other: Outcome, estimator: str) -> float:
    """Difference of the late means in combined standard errors."""
    (a, a_error), (b, b_error) = one.late_mean(estimator), other.late_mean(estimator)
    return (a - b) / math.hypot(a_error, b_error)


def z_steps(one: Outcome, other: Outcome, estimator: str) -> NDArray[np.float64]:
    """By step, the difference of the mean of tr P in combined standard errors; 0 where both have none."""
    a, b = one.traces[estimator], other.traces[estimator]
    error = np.hypot(a.std(axis=1, ddof=1), b.std(axis=1, ddof=1)) / math.sqrt(a.shape[1])
    difference = a.mean(axis=1) - b.mean(axis=1)
    return np.divide(difference, error, out=np.zeros_like(difference), where=error > 1e-12)


def report(outcomes: dict[str, Outcome]) -> str:
    """Markdown."""
    model = outcomes["model"]
    lines = ["| | " + " | ".join(outcomes) + " |", "|---" * (len(outcomes) + 1) + "|"]
    for name in ESTIMATORS:
        cells = [f"{mean:.3f} ± {error:.3f}" for mean, error in (each.late_mean(name) for each in outcomes.values())]
        lines.append(f"| {name}: tr P, last half | {' | '.join(cells)} |")
        cells = ["–" if each is model else f"{z_late(each, model, name):+.2f}" for each in outcomes.values()]
        lines.append(f"| {name}: z of the difference to the model | {' | '.join(cells)} |")
        inside = [np.mean(np.abs(z_steps(each, model, name)) <= Z_95) for each in outcomes.values()]
        cells = [
            "–" if each is model else f"{share:.0%}" for each, share in zip(outcomes.values(), inside, strict=True)
        ]
        lines.append(f"| {name}: steps with abs z ≤ 1.96 | {' | '.join(cells)} |")
        largest = [np.abs(z_steps(each, model, name)).max() for each in outcomes.values()]
        cells = ["–" if each is model else f"{z:.2f}" for each, z in zip(outcomes.values(), largest, strict=True)]
        lines.append(f"| {name}: largest abs z of a step | {' | '.join(cells)} |")
    for link in ARRIVAL:
        cells = [f"{e.lost(link)} ({e.loss_z(link):+.2f})" for e in outcomes.values()]
        lines.append(f"| {link}: lost of {model.links[link]['sent']} (z) | {' | '.join(cells)} |")
        lines.append(f"| {link}: late | {' | '.join(str(e.links[link]['late']) for e in outcomes.values())} |")
    return "\n".join(lines)


def compare(folder: Path, backends: tuple[str, ...], runs: int, **options: Any) -> dict[str, Outcome]:
    """Several runs over each backend, with a seed for each, so that they have nothing in common but the scenario."""
    seeds = iter(range(1, runs * len(backends) + 1))
    return {b: _together([run(folder, b, seed=next(seeds), **options) for _ in range(runs)]) for b in backends}


def _together(outcomes: list[Outcome]) -> Outcome:
    """The lanes of all runs side by side."""
    traces = {name: np.concatenate([each.traces[name] for each in outcomes], axis=1) for name in ESTIMATORS}
    links = {
        link: {
            "sent": sum(each.links[link]["sent"] for each in outcomes),
            "late": sum(each.links[link]["late"] for each in outcomes),
            "causes": {"loss": sum(each.lost(link) for each in outcomes)},
        }
        for link in ARRIVAL
    }
    return Outcome(traces, links, {})


if __name__ == "__main__":
    sizes: dict[str, Any] = {"lanes": int(sys.argv[1]), "steps": int(sys.argv[2]), "period": sys.argv[3], "runs": 3}
    with tempfile.TemporaryDirectory() as folder:
        print(report(compare(Path(folder), ("model", "relay", "kernel"), **sizes)))
