"""Performance targets, measured on demand: each benchmark pairs the testbed with its alternative in one run."""
