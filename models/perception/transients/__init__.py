"""Confocal photon transients of hidden objects: their shape by the light-cone transform, and the instrument's response."""
