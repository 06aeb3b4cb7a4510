"""Formats of radar boards that can be bought."""
