"""A distributed testbed for state estimation over lossy networks."""

__version__ = "0.1.0"
