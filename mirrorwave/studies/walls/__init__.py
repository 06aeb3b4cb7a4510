"""Walls: what they reflect and let through, by formula and by simulated waves."""
