"""Methods and profiles scored on the same frames."""
