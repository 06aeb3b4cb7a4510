"""From range-azimuth maps to classified peaks."""
