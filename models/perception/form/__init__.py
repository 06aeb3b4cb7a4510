"""Step 1: beams become range-azimuth maps."""
