"""Which packets a link loses: by a law, or as it is written down."""

from typing import Annotated

from pydantic import Field

from testbed.scenario.loss_laws import BernoulliLoss, FourStateLoss, GilbertElliottLoss, MarkovLoss, NoLoss
from testbed.scenario.replays import ScriptedLoss, TraceLoss

Loss = Annotated[
    NoLoss | BernoulliLoss | MarkovLoss | GilbertElliottLoss | FourStateLoss | TraceLoss | ScriptedLoss,
    Field(discriminator="kind"),
]
