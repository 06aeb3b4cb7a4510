"""Targets and losses of network training."""
