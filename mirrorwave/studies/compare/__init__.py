"""Three sensors on the same hidden scenes."""
