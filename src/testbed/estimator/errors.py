"""What an estimator can refuse."""

from __future__ import annotations

from testbed.errors import TestbedError


class MissingAck(TestbedError):
    """The estimator needs ν of the last control packet and no ACK of it has come."""


class TooManyHistories(TestbedError):
    """Exact enumeration has reached its limit."""


class ContradictoryAck(TestbedError):
    """An ACK reports what the model of the control link gives probability zero."""
