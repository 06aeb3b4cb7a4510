"""Across scans: ego-motion, walls and tracks in the odometry frame."""
