"""Verbs on captures, recordings and CAN logs."""
