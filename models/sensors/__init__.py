"""Formats of commercially available radar boards."""
