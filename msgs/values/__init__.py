"""Message values: the contents of topics, with units and frames."""
