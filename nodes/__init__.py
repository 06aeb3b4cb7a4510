"""Floor 4, thin wiring: each process of the graph, the loop they share, their supervisor."""
