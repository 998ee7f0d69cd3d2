"""The roles of a run: their names, what builds them, and how each is started as a process."""

from __future__ import annotations

from dataclasses import dataclass
from typing import get_args

from testbed.channel import service as link_service
from testbed.control import service as control_service
from testbed.estimator import bounds_service
from testbed.estimator import service as estimator_service
from testbed.plant import service as plant_service
from testbed.scenario import Scenario
from testbed.wire.keys import LinkName
from testbed.wire.setup import Build


@dataclass(frozen=True)
class RoleSpec:
    """A role: its name, its builder, and the module and arguments of its process."""

    name: str
    build: Build
    module: str
    arguments: tuple[str, ...] = ()


def roles_of(scenario: Scenario) -> list[RoleSpec]:
    """Every role of a scenario but the orchestrator."""
    roles = [
        RoleSpec(control_service.ROLE, control_service.build, "testbed.control"),
        RoleSpec(plant_service.ROLE, plant_service.PlantService, "testbed.plant"),
    ]
    for link in get_args(LinkName):
        if link != "ack" or scenario.links.ack.mode != "none":
            name = link_service.role_of(link)
            roles.append(RoleSpec(name, link_service.builder(link), "testbed.channel", ("--link", link)))
    if scenario.bounds:
        roles.append(RoleSpec(bounds_service.ROLE, bounds_service.BoundsService, "testbed.estimator.bounds_service"))
    for spec in scenario.estimators:
        name = estimator_service.role_of(spec.name)
        build = estimator_service.builder(spec.name)
        roles.append(RoleSpec(name, build, "testbed.estimator", ("--name", spec.name)))
    return roles
