"""Forming of range-azimuth maps from raw beams."""
