"""Scenes seen by LiDAR: single-photon histograms and point clouds."""
