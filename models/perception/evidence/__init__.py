"""Walls as a network sees them, and evidence of hidden objects gathered through them in the bird's-eye view."""
