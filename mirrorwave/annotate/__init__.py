"""Labels for radar captures from LiDAR clouds."""
