"""Commercially available radars, one module a kind: parameters, set-up, beams."""
