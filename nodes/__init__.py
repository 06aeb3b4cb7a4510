"""Floor 4, thin wiring: each process of the graph, their common loop, their supervisor."""
