"""Accuracy against time: rows of settings on the same beams."""
