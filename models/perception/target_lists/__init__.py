"""Peaks of radars that give target lists instead of beams."""
