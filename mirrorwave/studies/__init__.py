"""Studies over many frames: evaluation, accuracy versus time, comparison of sensors."""
