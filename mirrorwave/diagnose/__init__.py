"""Diagnosis of a running graph."""
