"""Radar boards: drivers, nodes and captures of each."""
