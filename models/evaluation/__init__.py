"""Scores against truth: per point, per object, with intervals."""
