"""Random scenes from seeds."""
