"""The inputs that follow an estimate: only their data. q is the number of input channels, n the size of the state."""

from typing import Any, Literal

from pydantic import Field, field_validator, model_validator

from testbed.scenario.base import Matrix, Part, ScalarOrVector, Vector, count, problem, sequence, shown, size
from testbed.scenario.definite import check_symmetric
from testbed.scenario.estimators import plain_options
from testbed.scenario.system import System


class ClosedLoop(Part):
    """What every controller in a closed loop has: the estimator that it follows, and limits."""

    estimator: str = Field(default="", description="Name of the estimator that closes the loop; default the first one.")
    low: ScalarOrVector | None = Field(
        default=None, description="Least input that is sent: a number, or a list of q; left out: no limit."
    )
    high: ScalarOrVector | None = Field(
        default=None, description="Largest input that is sent, not less than low; left out: no limit."
    )

    @model_validator(mode="after")
    def _ordered(self) -> "ClosedLoop":
        lows, highs = _listed(self.low), _listed(self.high)
        if min(len(lows), len(highs)) == 1 or len(lows) == len(highs):
            pairs = max(len(lows), len(highs))
            for low, high in zip(lows * (pairs // len(lows)), highs * (pairs // len(highs)), strict=True):
                if low > high:
                    raise problem(
                        f"got {shown(self.high)}; allowed: not less than low, which is {shown(self.low)}", "high"
                    )
        return self

    def check_sizes(self, system: System) -> None:
        """Raises a problem of validation where something does not fit the system."""
        self.check_lists(system.q, "low", "high")

    def check_lists(self, q: int, *keys: str) -> None:
        """Each list has q numbers, one for each channel."""
        for key in keys:
            value = getattr(self, key)
            if sequence(value) is not None and len(value) != q:
                raise problem(
                    f"got {count(len(value), 'number')}; allowed: {q}, the number of columns of system.B", key
                )


def _listed(value: float | tuple[float, ...] | None) -> tuple[float, ...]:
    """The numbers of a limit; one that no comparison refuses where there is none."""
    if value is None:
        return (float("nan"),)
    return value if isinstance(value, tuple) else (value,)


class FeedbackInput(ClosedLoop):
    """u_k = feedforward - gain (x_hat_k - reference): the loop is closed through an estimator."""

    kind: Literal["feedback"] = Field(default="feedback", description="Kind of input.")
    gain: Matrix = Field(description="Gain, q x n.")
    reference: Vector | None = Field(default=None, description="State to be held, n numbers; left out: zero.")
    feedforward: ScalarOrVector = Field(default=0.0, description="Input that is added: a number, or a list of q.")

    def check_sizes(self, system: System) -> None:
        """The same, with gain and reference."""
        super().check_sizes(system)
        rows, columns = size(self.gain)
        if rows != system.q:
            raise problem(f"got {count(rows, 'row')}; allowed: {system.q}, the number of columns of system.B", "gain")
        if columns != system.n:
            raise problem(f"got {rows} × {columns}; allowed: {system.q} × {system.n}", "gain")
        check_state("reference", self.reference, system.n)
        self.check_lists(system.q, "feedforward")


class LqgInput(ClosedLoop):
    """u_k = -L_k x_hat_k with the gain that minimises a quadratic cost, if every control packet is acknowledged."""

    kind: Literal["lqg"] = Field(default="lqg", description="Kind of input.")
    Qx: Matrix = Field(description="Weight of the state, n x n, symmetric, positive semi-definite.")
    Ru: Matrix = Field(description="Weight of the applied input, q x q, symmetric, positive definite.")
    horizon: Literal["stationary", "run"] = Field(
        default="stationary", description="stationary: the gain of an endless run; run: gains that end with this run."
    )
    terminal: Matrix | None = Field(
        default=None, description="Weight of the last state, n x n; only with horizon = 'run'; left out: Qx."
    )

    @field_validator("terminal")
    @classmethod
    def _ends(cls, terminal: Matrix | None, info: Any) -> Matrix | None:
        if terminal is not None and info.data.get("horizon") == "stationary":
            raise problem("got a weight of the last state with horizon 'stationary'; allowed: only with horizon 'run'")
        return terminal

    def check_sizes(self, system: System) -> None:
        """The same, with the weights."""
        super().check_sizes(system)
        check_weights(self.Qx, self.Ru, self.terminal, system, definite=True)


class PidInput(ClosedLoop):
    """A PID controller for each channel, on q outputs z = output x_hat; a step is the unit of time."""

    kind: Literal["pid"] = Field(default="pid", description="Kind of input.")
    output: Matrix | None = Field(
        default=None, description="What is controlled, z = output x_hat, q x n; left out: C, if that has q rows."
    )
    setpoint: ScalarOrVector = Field(default=0.0, description="What z shall be: a number, or a list of q.")
    kp: ScalarOrVector = Field(default=0.0, description="Proportional gain: a number, or a list of q.")
    ki: ScalarOrVector = Field(default=0.0, description="Integral gain, a step: a number, or a list of q.")
    kd: ScalarOrVector = Field(default=0.0, description="Derivative gain, in steps: a number, or a list of q.")
    filter: ScalarOrVector = Field(
        default=0.0, description="Time constant of the derivative's filter in steps, 0 or more: a number, or q."
    )
    feedforward: ScalarOrVector = Field(default=0.0, description="Input that is added: a number, or a list of q.")
    tracking: ScalarOrVector | None = Field(
        default=None,
        description="Anti-windup by back-calculation, with this time constant in steps, 1 or more; left out: the "
        "integral stops while the input is at a limit and the error drives it further.",
    )

    @field_validator("filter", "tracking")
    @classmethod
    def _times(cls, value: ScalarOrVector | None, info: Any) -> ScalarOrVector | None:
        least = 1 if info.field_name == "tracking" else 0
        if value is not None and any(entry < least for entry in (value if isinstance(value, tuple) else (value,))):
            raise problem(f"got {shown(value)}; allowed: {least} or more")
        return value

    def check_sizes(self, system: System) -> None:
        """The same, with gains and output."""
        super().check_sizes(system)
        self.check_lists(system.q, "setpoint", "kp", "ki", "kd", "filter", "feedforward", "tracking")
        if self.output is None and system.p != system.q:
            raise problem(
                f"missing, and C has {count(system.p, 'row')}; needed: {system.q} × {system.n}, an output for each "
                "input channel",
                "output",
            )
        if self.output is not None and size(self.output) != (system.q, system.n):
            rows, columns = size(self.output)
            raise problem(
                f"got {rows} × {columns}; allowed: {system.q} × {system.n}, an output for each input channel", "output"
            )


class PythonInput(ClosedLoop):
    """A controller of your own: a class in Python."""

    kind: Literal["python"] = Field(default="python", description="Kind of input.")
    controller: str = Field(
        min_length=1,
        description="MODULE:CLASS, the module also from the working folder, or a name registered under the entry "
        "points testbed.controllers.",
    )
    options: dict[str, Any] = Field(default_factory=dict, description="Keyword arguments of the class.")

    @field_validator("options")
    @classmethod
    def _plain(cls, options: dict[str, Any]) -> dict[str, Any]:
        return plain_options(options)


def check_state(key: str, value: tuple[float, ...] | None, n: int) -> None:
    """A problem of validation where a state has not n numbers."""
    if value is not None and len(value) != n:
        raise problem(f"got {count(len(value), 'number')}; allowed: {n}, the size of A", key)


def check_weights(
    Qx: Matrix, Ru: Matrix | None, terminal: Matrix | None, system: System, *, definite: bool = False
) -> None:
    """A problem of validation where weights of a quadratic cost do not fit; ``definite``: as Ru must be."""
    check_symmetric("Qx", Qx, system.n, "the size of A", at="Qx")
    if Ru is not None:
        check_symmetric("Ru", Ru, system.q, "the number of columns of B", definite=definite, at="Ru")
    if terminal is not None:
        check_symmetric("terminal", terminal, system.n, "the size of A", at="terminal")
