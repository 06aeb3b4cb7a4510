"""Message values: what topics carry, with units and frames."""
