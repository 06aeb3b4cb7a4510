"""Verbs that train, export, evaluate and compare."""
