"""Trade-off of accuracy against time."""
