"""The vehicle's own motion, as reported by its CAN bus: pure rules on frames, ages and ranges."""
