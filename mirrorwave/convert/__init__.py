"""Recordings and captures in other formats, both ways."""
