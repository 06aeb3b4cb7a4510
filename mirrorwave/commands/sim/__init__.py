"""Verbs of the simulator."""
