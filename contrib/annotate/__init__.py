"""LiDAR clouds as labels of radar captures."""
