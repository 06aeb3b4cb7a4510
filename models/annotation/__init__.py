"""Ground truth of real captures from LiDAR."""
