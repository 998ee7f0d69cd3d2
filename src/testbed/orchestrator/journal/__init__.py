"""The journal of a run: what it takes to finish the run after its orchestrator has died."""

from testbed.orchestrator.journal.reading import Found, read
from testbed.orchestrator.journal.writing import Journal

__all__ = ["Found", "Journal", "read"]
