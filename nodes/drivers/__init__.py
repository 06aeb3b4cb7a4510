"""Radars that can be bought, one module a kind: parameters, set-up, beams."""
