"""What of a scenario cannot be done over real links: known before anything starts."""

from __future__ import annotations

from testbed.channel.chains import chain_of
from testbed.channel.in_time import has_formula
from testbed.channel.real.middle import directions, scheme_of
from testbed.channel.sockets.tcp_proxy import TcpProxy
from testbed.errors import UsageError
from testbed.scenario import Scenario, ScriptedLoss, TraceLoss
from testbed.scenario.backend import real_links
from testbed.scenario.links import SteppedImpairments


def check_links(scenario: Scenario) -> None:
    """Raises UsageError for a link that its backend cannot do, on this machine or at all."""
    names = real_links(scenario)
    if names and scenario.clock.real:
        _check_deadlines(scenario, names)
    for name in names:
        for variant in scenario.variants(name):
            check_link(scenario, name, variant)
    kernel = [name for name in names if getattr(scenario.links, name).backend == "kernel"]
    if kernel:
        _check_kernel(kernel[0])


def _check_deadlines(scenario: Scenario, names: list[str]) -> None:
    """Raises UsageError where an estimate could never be in time: that a packet is lost is known at its deadline."""
    period_ns = scenario.clock.period_ns
    ns = {name: getattr(scenario.links, name).deadline_ns(period_ns) if name in names else 0 for name in names}
    last = max(("observation", "ack"), key=lambda name: ns.get(name, 0))
    way = [name for name in ("control", last) if ns.get(name, 0)]
    total, allowed = sum(ns[name] for name in way), scenario.clock.deadline_ns
    if total >= allowed:
        which = " + ".join(f"links.{name}.deadline" for name in way)
        raise UsageError(
            f"{which}: got {total / 1e6:g} ms with clock mode 'real'; allowed: less than clock.deadline, "
            f"{allowed / 1e6:g} ms, for the loss of a packet is known at its deadline"
        )


def check_link(scenario: Scenario, name: str, link: SteppedImpairments) -> None:
    """Raises UsageError where the link cannot be like that."""
    where = f"links.{name}"
    if not link.is_real:
        return
    if link.backend == "relay" and scheme_of(link) == "tcp":
        for impairments in directions(link):
            try:
                TcpProxy.check(impairments)
            except UsageError as error:
                raise UsageError(f"{where}: backend 'relay' with transport 'tcp': {error}") from None
    per_packet = scenario.transport.lanes_per_packet
    if per_packet is not None and per_packet < scenario.lanes and link.assumed is None and not _independent(link):
        raise UsageError(
            f"{where}: backend {link.backend!r} with several packets a step: they share one chain and one queue; "
            "allowed: independent losses or clock 'time', without a rate; all lanes in one packet (no "
            "transport.lanes_per_packet); or links.NAME.assumed, which says what estimators take the losses for"
        )


def _independent(link: SteppedImpairments) -> bool:
    """Whether it does not matter to a packet what goes between it and the one of the step before."""
    if isinstance(link.loss, TraceLoss | ScriptedLoss):
        return False
    if link.rate is not None or (link.transport is None and not has_formula(link)):
        return False
    return link.slot is not None or bool(chain_of(link.loss).independent)


def _check_kernel(name: str) -> None:
    from testbed.channel.kernel.doctor import can_make_hosts

    finding = can_make_hosts()
    if not finding.ok:
        raise UsageError(
            f"links.{name}.backend: got 'kernel', but this machine has {finding.found} ({finding.advice}); "
            "allowed: relay, which needs no rights, or model"
        )
