"""From raw beams to range-azimuth maps."""
