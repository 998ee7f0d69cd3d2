"""The clock of a run, and the transport between its processes."""

import re
from typing import Annotated, Any, Literal

from pydantic import BeforeValidator, Field, model_validator

from testbed.scenario.base import Count, Part, problem, shown
from testbed.scenario.durations import Duration, parse_duration


class Clock(Part):
    """How time passes. `period_ns` is the period in nanoseconds, `deadline_ns` the deadline of a step."""

    mode: Literal["virtual", "real"] = Field(
        default="virtual",
        description="virtual: simulated time, as fast as the processes can go; real: the wall clock keeps the period.",
    )
    period: Duration = Field(default="10 ms", description="Time of one step, a duration such as '10 ms'.")
    window: Count | None = Field(
        default=None,
        description="Steps that may be in flight at once, 1 or more; in real time more than that behind the wall "
        "clock end the run; left out: chosen by the run.",
    )
    deadlines: Literal["soft", "strict"] | None = Field(
        default=None,
        description="In real time, what a missed deadline does; soft: it is counted; strict: it ends the run; left "
        "out: soft.",
    )
    deadline: Duration | None = Field(
        default=None,
        description="In real time, how long after u_k was due everything of step k + 1 is; left out: the period.",
    )

    priority: int | None = Field(
        default=None,
        ge=1,
        le=99,
        description="In real time, the real-time priority (SCHED_FIFO) of the run's processes on this host, where the "
        "system permits it; left out: none.",
    )

    @model_validator(mode="after")
    def _real_only(self) -> "Clock":
        for key in ("deadlines", "deadline", "priority"):
            if self.mode == "virtual" and getattr(self, key) is not None:
                raise problem(f"got {shown(getattr(self, key))}; allowed: only with mode 'real'", key)
        return self

    @property
    def real(self) -> bool:
        """Whether the wall clock keeps the period."""
        return self.mode == "real"

    @property
    def period_ns(self) -> int:
        """The period in nanoseconds."""
        return parse_duration(self.period)

    @property
    def deadline_ns(self) -> int:
        """What of a step comes later than so many nanoseconds after its control was due is late."""
        return parse_duration(self.deadline or self.period)


class Tls(Part):
    """TLS between the processes. Paths are relative to the scenario's folder; resolved, they are absolute."""

    ca: str = Field(min_length=1, description="File of the authority's certificate (PEM).")
    certificate: str = Field(min_length=1, description="File of the router's certificate (PEM).")
    key: str = Field(min_length=1, description="File of the router's private key (PEM).")
    client_certificate: str | None = Field(
        default=None, min_length=1, description="File of the clients' certificate (PEM); given: mutual TLS."
    )
    client_key: str | None = Field(default=None, min_length=1, description="File of the clients' private key (PEM).")

    @model_validator(mode="after")
    def _client_pair(self) -> "Tls":
        if (self.client_certificate is None) != (self.client_key is None):
            given, lacking = "client_certificate", "client_key"
            if self.client_certificate is None:
                given, lacking = lacking, given
            raise problem(f"got {given} without {lacking}; allowed: both or neither", given)
        return self


_ENDPOINT = re.compile(r"(tcp|tls)/(\[[0-9A-Fa-f:.]+\]|[^\s/:\[\]]+):([0-9]{1,5})", re.ASCII)


def _endpoint(value: Any) -> Any:
    if value is None:
        return None
    match = _ENDPOINT.fullmatch(value) if isinstance(value, str) else None
    if match is None or not 1 <= int(match[3]) <= 65535:
        raise problem(f"got {shown(value)}; allowed: tcp/HOST:PORT or tls/HOST:PORT, PORT 1 … 65535")
    return value


class Transport(Part):
    """How the processes of a run talk. `deadline_ns` is the deadline in nanoseconds."""

    endpoint: Annotated[str | None, BeforeValidator(_endpoint)] = Field(
        default=None,
        description="Where the run listens, such as tcp/127.0.0.1:7447; left out: this host only, on a free port.",
    )
    deadline: Duration = Field(
        default="10 s", description="A run without progress for that long has failed; a duration such as '10 s'."
    )
    lanes_per_packet: Count | None = Field(
        default=None, description="The most lanes that one packet carries, 1 or more; left out: all of them."
    )
    shared_memory: bool | None = Field(
        default=None,
        description="Whether large packets pass between processes of one host through shared memory; left out: where "
        "they are large and the run listens on this host only.",
    )
    tls: Tls | None = Field(default=None, description="Encryption; left out: none.")
    user: str | None = Field(default=None, min_length=1, description="User name of the processes.")
    password_env: str | None = Field(
        default=None, min_length=1, description="Name of the environment variable that holds the user's password."
    )
    users_file: str | None = Field(
        default=None,
        min_length=1,
        description="File of the users that may connect, a line user:password each; relative to the scenario's folder.",
    )

    @property
    def deadline_ns(self) -> int:
        """The deadline in nanoseconds."""
        return parse_duration(self.deadline)

    @model_validator(mode="after")
    def _agree(self) -> "Transport":
        if self.endpoint is not None and self.endpoint.startswith("tls/") != (self.tls is not None):
            wanted = "tls/… with [transport.tls], tcp/… without"
            raise problem(f"got {shown(self.endpoint)}; allowed: {wanted}", "endpoint")
        if (self.user is None) != (self.password_env is None):
            given = "user" if self.password_env is None else "password_env"
            raise problem(f"got only {given}; allowed: user and password_env, both or neither", given)
        return self
