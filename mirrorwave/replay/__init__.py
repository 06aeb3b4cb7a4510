"""Recordings played into a graph or under the page."""
