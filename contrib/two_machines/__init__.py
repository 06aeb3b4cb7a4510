"""A graph over several machines: keys, link, checks."""
