"""Calibration of radar, array and mounting from captures."""
