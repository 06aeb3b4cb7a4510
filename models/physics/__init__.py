"""Radar physics: waveform, antenna, mirror geometry, reflection."""
