"""Calibration of radar, mounting and clock from captures."""
