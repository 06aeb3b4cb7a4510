"""Processes of the graph: launch files, supervisor, liveness, logs."""
