"""What the events of links make of them, one after the other."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

from testbed.errors import UsageError
from testbed.scenario.base import problem, shown
from testbed.scenario.changes import changed
from testbed.scenario.events import CutEvent, LinkEvent, PartitionEvent
from testbed.scenario.links import Links, SteppedImpairments

LinkChange = LinkEvent | CutEvent
Table = dict[str, Any]


def links_of(links: Links) -> list[str]:
    """Those of a run that carry packets, which can be lost."""
    return [name for name in Links.model_fields if name != "ack" or links.ack.mode == "link"]


class LinkWalk:
    """The links as the events taken so far have left them."""

    def __init__(self, links: Links) -> None:
        self._names = links_of(links)
        self._mode = links.ack.mode
        self.now: dict[str, SteppedImpairments] = {name: getattr(links, name) for name in Links.model_fields}

    def take(self, event: LinkChange, at: str = "") -> dict[str, Table]:
        """By link: the keys of its table that change. A problem of validation where the event does not fit."""
        tables = self._tables(event, at)
        for name, table in tables.items():
            try:
                self.now[name] = changed(self.now[name], table)
            except UsageError as error:
                raise problem(str(error), f"{at}.set") from None
        return tables

    def _tables(self, event: LinkChange, at: str) -> dict[str, Table]:
        if isinstance(event, LinkEvent):
            self._there(event.link, f"{at}.link")
            if "up" in event.set:
                raise problem("up: cannot be set; allowed: the events partition and heal", f"{at}.set")
            if not self.now[event.link].up:
                raise problem(f"got {event.link!r}, which is cut then; allowed: after its heal", f"{at}.link")
            return {event.link: event.set}
        for name in event.links or ():
            self._there(name, f"{at}.links")
        cuts = isinstance(event, PartitionEvent)
        whole = [name for name in self._names if self.now[name].up]
        fitting = whole if cuts else [name for name in self._names if name not in whole]
        names = list(event.links) if event.links is not None else fitting
        wrong = next((name for name in names if name not in fitting), None)
        if wrong is not None or not names:
            what = "is cut already" if cuts else "is not cut then"
            told = f"{wrong!r}, which {what}" if wrong is not None else "all" if cuts else "all, and none is cut then"
            raise problem(f"got {told}; allowed: {', '.join(fitting) or 'none'}", f"{at}.links")
        return {name: {"up": not cuts} for name in names}

    def _there(self, name: str, at: str) -> None:
        if name not in self._names:
            raise problem(f"got {shown(name)} with mode {self._mode!r}; allowed: only with mode 'link'", at)


def changes_in(links: Links, events: Iterable[tuple[int, LinkChange]]) -> dict[str, list[tuple[int, Table]]]:
    """By link: (step, keys with their new values), in the order of time; those of one step in the order given."""
    walk = LinkWalk(links)
    out: dict[str, list[tuple[int, Table]]] = {}
    for step, event in sorted(events, key=lambda entry: entry[0]):
        for name, table in walk.take(event).items():
            out.setdefault(name, []).append((step, table))
    return out
