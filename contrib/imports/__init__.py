"""Detections and side sensors out of recordings that others made."""
