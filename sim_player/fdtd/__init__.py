"""Walls by finite differences in time (FDTD): reflection and transmission, smooth and rough, and the field itself."""
