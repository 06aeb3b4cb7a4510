"""Methods and profiles over the same frames and places, with intervals."""
