"""Targets, losses, training and export. With models/networks the only package that imports torch."""
