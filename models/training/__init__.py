"""Targets, losses, training and export. The only place beside models/networks that imports torch."""
