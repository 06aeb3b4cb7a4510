"""Walls, hidden points and objects of one scan from its classified peaks."""
