"""What a script can order of a run: a method for each action of the timeline."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping
from typing import Any

from testbed.orchestrator.live.ordered import Ordered

To = str | Mapping[str, Any]


class Actions(ABC):
    """Each method is an action of [[events]] with its keys, and raises UsageError where it cannot be."""

    @abstractmethod
    def do(self, action: str, **keys: Any) -> Ordered:
        """Any action by its name, with the keys of its table; those that are None are left out."""

    def swap(self, estimator: str, to: To, handover: str | None = None) -> Ordered:
        """Let another service take over an estimator: a table with its kind, or the name of one that runs.

        handover: what it starts from: cold, moments (if left out) or full.
        """
        return self.do("swap", estimator=estimator, to=to, handover=handover)

    def shadow(self, estimator: str, name: str, to: To, handover: str | None = None) -> Ordered:
        """Let an estimator run beside another one, from its knowledge, under a name of its own."""
        return self.do("shadow", estimator=estimator, name=name, to=to, handover=handover)

    def add(self, estimator: str, to: To) -> Ordered:
        """Add an estimator of that name; it knows the prior and no more."""
        return self.do("add", estimator=estimator, to=to)

    def remove(self, estimator: str) -> Ordered:
        """Let an estimator leave."""
        return self.do("remove", estimator=estimator)

    def set(self, link: str, **keys: Any) -> Ordered:
        """Let keys of a link have other values, such as ``loss={"arrival": 0.3}``."""
        return self.do("set", link=link, set=keys)

    def acks(self, acks: str, estimator: str | None = None) -> Ordered:
        """Switch the ACKs of an estimator, or of all that run: none, perfect or link."""
        return self.do("acks", acks=acks, estimator=estimator)

    def input(self, **table: Any) -> Ordered:
        """Another open-loop input: its table, such as ``kind="constant", value=[1.0]``."""
        return self.do("input", input=table)

    def plant(self, *, over: int | None = None, **parameters: Any) -> Ordered:
        """Give the plant other parameters, A, B, C, Q, R, G, in a straight line ``over`` so many steps."""
        return self.do("plant", over=over, **parameters)

    def partition(self, *links: str) -> Ordered:
        """Let nothing through some links; none named: all of the run."""
        return self.do("partition", links=list(links) or None)

    def heal(self, *links: str) -> Ordered:
        """Make links whole again; none named: all that are cut."""
        return self.do("heal", links=list(links) or None)

    def mark(self, name: str) -> Ordered:
        """A mark in the results; it changes nothing."""
        return self.do("mark", name=name)

    def snapshot(self, estimator: str, name: str | None = None) -> Ordered:
        """Write the state of an estimator down."""
        return self.do("snapshot", estimator=estimator, name=name)

    def kill(self, role: str) -> Ordered:
        """Kill a process by its role, such as "plant" or "estimator.aoe"."""
        return self.do("kill", role=role)

    def pause(self, role: str, lasts: str) -> Ordered:
        """Stop a process, and continue it after a duration such as "200 ms"."""
        return self.do("pause", role=role, **{"for": lasts})

    def restart(self, role: str) -> Ordered:
        """End a process and start it anew."""
        return self.do("restart", role=role)


class Moment(Actions):
    """Orders for one step, time or condition: ``moment`` is the key that says which."""

    def __init__(self, order: Callable[[dict[str, Any]], Ordered], moment: dict[str, Any]) -> None:
        self._order, self._moment = order, moment

    def do(self, action: str, **keys: Any) -> Ordered:
        """Any action by its name, with the keys of its table."""
        return self._order({"action": action, **keys, **self._moment})
