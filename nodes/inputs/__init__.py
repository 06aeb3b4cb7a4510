"""Inputs of nodes: queues, histories joined by stamp, ages of views."""
