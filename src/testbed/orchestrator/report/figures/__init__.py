"""The figures of the report: each file draws one from a summary."""
