"""Meshes of objects and what they send back."""
