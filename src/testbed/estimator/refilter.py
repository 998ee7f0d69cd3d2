"""Late and out-of-order observations and ACKs: kept inputs and checkpoints, and the steps since run again.

What an estimator knows at step k then is what it would know had all that has come by k come in time. Steps are
remembered for ``depth`` steps; what is older is counted and not used. The work of a late packet is at most
2 · depth steps, the memory 2 · depth inputs and three states.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from testbed.errors import UsageError
from testbed.estimator.model import Ack, Estimate, Estimator, Restartable
from testbed.numerics.lanes import Floats


@dataclass(frozen=True, eq=False)
class LateObservation:
    """y_j (M, p) of an earlier step j, in the lanes where ``arrived`` (M,)."""

    j: int
    y: Floats
    arrived: NDArray[Any]


@dataclass
class _Inputs:
    """All that is known of one step by now."""

    u: Floats
    y: Floats
    arrived: NDArray[np.bool_]
    acks: list[Ack]


class Refilter:
    """An estimator with a memory of ``depth`` steps. With depth 0 late observations are counted and not used.

    counters: those of the estimator, and ``refiltered`` (steps run again, from what was late in the
    lane on), ``late_observations`` (used), ``old_observations`` (too old), ``repeated_observations`` (already there),
    each over all lanes.
    """

    def __init__(self, estimator: Estimator, depth: int) -> None:
        """Raises UsageError for a negative depth, and where the estimator cannot go back to a state."""
        if depth < 0:
            raise UsageError(f"buffer: got {depth}; allowed: 0 or more steps")
        if depth and not isinstance(estimator, Restartable):
            raise UsageError("buffer: the estimator gives no state to go back to; allowed: 0")
        self.estimator, self._depth = estimator, depth
        self._own: dict[str, int] = {}
        self._k = 0
        self._inputs: dict[int, _Inputs] = {}
        self._checkpoints: dict[int, tuple[dict[str, NDArray[Any]], dict[str, int]]] = {}
        self._checkpoint()

    @property
    def counters(self) -> dict[str, int]:
        return {**self.estimator.counters, **self._own}

    def begin_at(self, step: int) -> None:
        """Go on from the estimator as it is now, after ``step`` steps; nothing before is remembered."""
        self._k, self._inputs, self._checkpoints, self._own = step, {}, {}, {}
        self._checkpoint()

    def memory(self) -> dict[str, NDArray[Any]]:
        """What is remembered, as arrays: counters, inputs, ACKs, and the states to go back to."""
        counters = {f"counter.{name}": np.array(count, dtype=np.int64) for name, count in self._own.items()}
        if not self._depth:
            return counters
        steps = list(self._inputs)
        known = [self._inputs[step] for step in steps]
        acks = [(step, ack) for step, kept in zip(steps, known, strict=True) for ack in kept.acks]
        out: dict[str, NDArray[Any]] = {**counters, "steps": np.array(steps, dtype=np.int64)}
        if steps:
            out |= {"u": np.array([k.u for k in known]), "y": np.array([k.y for k in known])}
            out["arrived"] = np.array([k.arrived for k in known], dtype=np.uint8)
        if acks:
            out["ack_steps"] = np.array([step for step, _ in acks], dtype=np.int64)
            out["ack_of"] = np.array([ack.j for _, ack in acks], dtype=np.int64)
            out["ack_nu"] = np.array([ack.nu for _, ack in acks], dtype=np.uint8)
            out["ack_known"] = np.array([ack.known for _, ack in acks], dtype=np.uint8)
        out["checkpoints"] = np.array(list(self._checkpoints), dtype=np.int64)
        for i, (state, counts) in enumerate(self._checkpoints.values()):
            out |= {f"{i}.state.{name}": array for name, array in state.items()}
            out |= {f"{i}.counter.{name}": np.array(count, dtype=np.int64) for name, count in counts.items()}
        return out

    def remember(self, step: int, memory: Mapping[str, NDArray[Any]]) -> None:
        """Go on from the estimator as it is now, after ``step`` steps, with the ``memory`` of another one like it.

        Raises UsageError where it is none.
        """
        self.begin_at(step)
        counter = "counter."
        self._own = {n.removeprefix(counter): int(count) for n, count in memory.items() if n.startswith(counter)}
        if not self._depth or "steps" not in memory:
            return
        try:
            self._recall(memory)
        except (KeyError, IndexError, ValueError, TypeError) as error:
            raise UsageError(f"memory of late packets: {type(error).__name__}: {error}") from None
        self._forget()

    def _recall(self, memory: Mapping[str, NDArray[Any]]) -> None:
        steps = memory["steps"].tolist()
        for i, step in enumerate(steps):
            arrived = np.array(memory["arrived"][i], dtype=np.bool_)
            self._inputs[step] = _Inputs(np.array(memory["u"][i]), np.array(memory["y"][i]), arrived, [])
        if "ack_steps" in memory:
            for i, step in enumerate(memory["ack_steps"].tolist()):
                ack = Ack(int(memory["ack_of"][i]), np.array(memory["ack_nu"][i]), np.array(memory["ack_known"][i]))
                self._inputs[step].acks.append(ack)
        kept = {}
        for i, step in enumerate(memory["checkpoints"].tolist()):
            state, counts = f"{i}.state.", f"{i}.counter."
            kept[step] = (
                {name.removeprefix(state): array for name, array in memory.items() if name.startswith(state)},
                {name.removeprefix(counts): int(c) for name, c in memory.items() if name.startswith(counts)},
            )
        if kept:
            self._checkpoints = kept
        if self._inputs and (max(self._inputs) != self._k or min(self._checkpoints) >= min(self._inputs)):
            raise ValueError("its steps do not fit together")

    def step(
        self,
        u: Floats,
        y: Floats,
        arrived: NDArray[Any],
        acks: tuple[Ack, ...] = (),
        late: Iterable[LateObservation] = (),
    ) -> Estimate:
        """As Estimator.step, with the observations of earlier steps that came since the last step."""
        if not self._depth:
            for observation in late:
                self._count("old_observations", observation.arrived)
            self._k += 1
            return self.estimator.step(u, y, arrived, acks)
        kept = [ack for ack in acks if self._remembered(ack.j + 1) and np.any(ack.known)]
        others = [ack for ack in acks if not self._remembered(ack.j + 1)]
        news = [*map(self._observe, late), *map(self._acknowledge, kept)]
        again = min((step for step, _ in news), default=self._k + 1)
        if again <= self._k:
            self._count_rerun(news)
            self._rerun(again)
        self._k += 1
        self._inputs[self._k] = _Inputs(np.array(u), np.array(y), np.array(arrived, dtype=np.bool_), others)
        estimate = self._execute(self._k)
        self._forget()
        return estimate

    def _remembered(self, step: int) -> bool:
        return max(1, self._k + 1 - self._depth) <= step <= self._k and step in self._inputs

    def _observe(self, late: LateObservation) -> tuple[int, NDArray[np.bool_]]:
        """Note a late observation; the step from which on it matters, and the lanes."""
        arrived = np.asarray(late.arrived, dtype=np.bool_)
        if not self._remembered(late.j):
            self._count("old_observations", arrived)
            return self._k + 1, arrived
        known = self._inputs[late.j]
        fresh = arrived & ~known.arrived
        self._count("repeated_observations", arrived & known.arrived)
        if not fresh.any():
            return self._k + 1, fresh
        self._count("late_observations", fresh)
        known.y[fresh] = np.asarray(late.y)[fresh]
        known.arrived |= fresh
        return late.j, fresh

    def _acknowledge(self, ack: Ack) -> tuple[int, NDArray[np.bool_]]:
        """Note a late ACK at the step that its packet moved to; the step from which on it matters, and the lanes."""
        known = self._inputs[ack.j + 1]
        before = next((other for other in known.acks if other.j == ack.j), ack)
        either = np.asarray(before.known, dtype=np.bool_) | np.asarray(ack.known, dtype=np.bool_)
        whole = Ack(ack.j, np.where(ack.known, ack.nu, before.nu), either)
        known.acks = [other for other in known.acks if other.j != ack.j] + [whole]
        return ack.j + 1, np.asarray(ack.known, dtype=np.bool_)

    def _count_rerun(self, news: list[tuple[int, NDArray[np.bool_]]]) -> None:
        """In each lane, the steps from the first of what is new in it until now."""
        first = np.full(len(news[0][1]), self._k + 1)
        for step, lanes in news:
            first[lanes] = np.minimum(first[lanes], step)
        self._own["refiltered"] = self._own.get("refiltered", 0) + int((self._k + 1 - first).sum())

    def _rerun(self, first: int) -> None:
        """Go back to the last checkpoint before ``first``, and on to where we were."""
        begin = max(k for k in self._checkpoints if k < first)
        self._checkpoints = {k: kept for k, kept in self._checkpoints.items() if k <= begin}
        state, counters = self._checkpoints[begin]
        assert isinstance(self.estimator, Restartable)
        self.estimator.set_state(state)
        self.estimator.counters.clear()
        self.estimator.counters.update(counters)
        reached, self._k = self._k, begin
        for step in range(begin + 1, reached + 1):
            self._k = step
            self._execute(step)

    def _execute(self, step: int) -> Estimate:
        known = self._inputs[step]
        estimate = self.estimator.step(known.u, known.y, known.arrived, tuple(known.acks))
        if step % self._depth == 0:
            self._checkpoint()
        return estimate

    def _checkpoint(self) -> None:
        if self._depth and isinstance(self.estimator, Restartable):
            self._checkpoints[self._k] = dict(self.estimator.state()), dict(self.estimator.counters)

    def _forget(self) -> None:
        """Keep the last checkpoint from which every remembered step can be run again, and what came after it."""
        far = max(0, self._k - self._depth)
        oldest = max((k for k in self._checkpoints if k <= far), default=min(self._checkpoints))
        self._checkpoints = {k: kept for k, kept in self._checkpoints.items() if k >= oldest}
        self._inputs = {k: kept for k, kept in self._inputs.items() if k > oldest}

    def _count(self, name: str, lanes: NDArray[Any]) -> None:
        count = int(np.count_nonzero(lanes))
        if count:
            self._own[name] = self._own.get(name, 0) + count
