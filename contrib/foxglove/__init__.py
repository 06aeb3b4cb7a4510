"""The bridge to Foxglove and its recordings."""
