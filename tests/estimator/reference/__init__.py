"""Estimates computed from their definitions: enumerate the control losses, stack the Gaussians, condition."""
