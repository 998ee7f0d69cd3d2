"""The orchestrator: starts the roles, drives the clock, collects, reports."""
