"""Estimators: one a file, pure; the registry; the service."""
