"""Walls by formula and by full wave: reflection, transmission, curves."""
