"""The vehicle's own motion, as its CAN bus tells it: pure rules on frames, ages and ranges."""
