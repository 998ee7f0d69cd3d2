"""What a run does when one of its processes is lost."""

from __future__ import annotations

import re
from typing import Annotated, Literal

from pydantic import BeforeValidator, Field, field_validator

from testbed.scenario.base import Count, Part, problem, shown
from testbed.scenario.durations import Duration, parse_duration

Policy = Literal["restart", "continue", "fail"]
MAY_BE_MISSED = "estimator."
_ROLE = re.compile(r"controller|plant|bounds|link\.(control|observation|ack)|estimator\.[a-z][a-z0-9_-]{0,63}")


def _roles(value: object) -> object:
    if isinstance(value, dict):
        for role in value:
            if not isinstance(role, str) or not _ROLE.fullmatch(role):
                raise problem(
                    f"got {shown(role)}; allowed: controller, plant, link.control, link.observation, link.ack, bounds, "
                    "estimator.NAME"
                )
    return value


class Recovery(Part):
    """A process that is killed, hangs or loses its connection: what becomes of the run, and what is kept for that."""

    policy: Policy | None = Field(
        default=None,
        description="restart: from its last snapshot, with the packets since, to the same figures; continue: without "
        "it (estimators that no controller follows; other roles as if left out); fail: the run ends. Left out: restart "
        "where the role can give its state, else fail.",
    )
    roles: Annotated[dict[str, Policy], BeforeValidator(_roles)] = Field(
        default_factory=dict, description="The policy of single roles, such as { 'estimator.aoe' = 'continue' }."
    )
    every: Count | None = Field(
        default=None,
        description="Steps from one snapshot to the next; what was sent since the last but one is kept in memory. Left "
        "out: as many as fit into a few megabytes.",
    )
    restarts: Annotated[int, Field(ge=0, le=1000)] = Field(
        default=3, description="How often one role is started anew before the run fails."
    )
    patience: Duration | None = Field(
        default=None,
        description="A role that gives no sign of life for so long while the run stands still is taken for hung; left "
        "out: half of transport.deadline.",
    )
    journal: bool | None = Field(
        default=None,
        description="Whether the run can be resumed where the orchestrator itself dies; left out: yes with processes, "
        "no with everything in one.",
    )

    @field_validator("roles")
    @classmethod
    def _check_roles(cls, roles: dict[str, Policy]) -> dict[str, Policy]:
        for role, policy in roles.items():
            if policy == "continue" and not role.startswith(MAY_BE_MISSED):
                raise problem(f"got 'continue'; allowed for {role}: restart, fail", role)
        return roles

    @property
    def asked(self) -> bool:
        """Whether anything was said of it."""
        return self != Recovery()

    @property
    def nothing_kept(self) -> bool:
        """Whether nothing can be recovered: no role, and not the run."""
        return self.policy == "fail" and set(self.roles.values()) <= {"fail"} and self.journal is False

    @property
    def patience_ns(self) -> int | None:
        return None if self.patience is None else parse_duration(self.patience)

    def wanted(self, role: str) -> Policy | None:
        """What the scenario says of a role; None: nothing. ``continue`` counts where a run can go on without it."""
        name = role_name(role)
        if name in self.roles:
            return self.roles[name]
        if self.policy == "continue" and not role.startswith(MAY_BE_MISSED):
            return None
        return self.policy


def role_name(role: str) -> str:
    """Of a service that took over from another, the role in the scenario: estimator.x.2 is estimator.x."""
    kind, dot, name = role.partition(".")
    return f"{kind}{dot}{name.partition('.')[0]}" if kind == "estimator" else role
