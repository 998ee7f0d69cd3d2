"""The scenario: its models, its file, its errors.

A scenario is read once, by `load_scenario` or `parse_scenario`; what comes out is complete, checked and immutable.
"""

from testbed.scenario.actuator import Actuator, OnLoss
from testbed.scenario.closed_loop import ClosedLoop, FeedbackInput, LqgInput, PidInput, PythonInput
from testbed.scenario.cost import Cost
from testbed.scenario.durations import format_duration, parse_duration
from testbed.scenario.estimators import EstimatorSpec
from testbed.scenario.inputs import (
    ConstantInput,
    ExponentialInput,
    Input,
    SineInput,
    TableInput,
    UniformInput,
)
from testbed.scenario.links import AckLink, Link, Links, ObservationLink
from testbed.scenario.load import load_scenario, parse_scenario
from testbed.scenario.loss_laws import (
    BernoulliLoss,
    FourStateLoss,
    GilbertElliottLoss,
    LossLaw,
    MarkovLoss,
    NoLoss,
)
from testbed.scenario.losses import Loss
from testbed.scenario.models import Following, Scenario
from testbed.scenario.replays import ScriptedLoss, TraceLoss
from testbed.scenario.schema import scenario_json_schema
from testbed.scenario.system import System
from testbed.scenario.transport import Clock, Tls, Transport
from testbed.scenario.uncertainty import Uncertainty
from testbed.scenario.write import to_dict, to_toml

__all__ = [
    "AckLink",
    "Actuator",
    "BernoulliLoss",
    "Clock",
    "ClosedLoop",
    "ConstantInput",
    "Cost",
    "EstimatorSpec",
    "ExponentialInput",
    "FeedbackInput",
    "Following",
    "FourStateLoss",
    "GilbertElliottLoss",
    "Input",
    "Link",
    "Links",
    "Loss",
    "LossLaw",
    "LqgInput",
    "MarkovLoss",
    "NoLoss",
    "ObservationLink",
    "OnLoss",
    "PidInput",
    "PythonInput",
    "Scenario",
    "ScriptedLoss",
    "SineInput",
    "System",
    "TableInput",
    "Tls",
    "TraceLoss",
    "Transport",
    "Uncertainty",
    "UniformInput",
    "format_duration",
    "load_scenario",
    "parse_duration",
    "parse_scenario",
    "scenario_json_schema",
    "to_dict",
    "to_toml",
]
