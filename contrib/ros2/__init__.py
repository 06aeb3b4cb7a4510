"""The bridge to ROS 2 and its recordings."""
