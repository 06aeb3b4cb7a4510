"""Detection of classified peaks in range-azimuth maps."""
