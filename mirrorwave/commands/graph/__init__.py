"""Verbs that start or inspect a running graph."""
