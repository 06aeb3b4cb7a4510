"""Samples and range profiles from paths: array, waveform, receiver."""
