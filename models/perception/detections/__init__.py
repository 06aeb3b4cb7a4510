"""Peaks from the detections of a radar that gives no beats."""
