"""Confocal photon transients: hidden shapes by the light-cone transform, and the response of the instrument."""
