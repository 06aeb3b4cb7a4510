"""Perception from raw beams to hidden objects: pure functions on arrays."""
