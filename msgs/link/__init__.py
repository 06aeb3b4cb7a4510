"""Encrypted links between hosts: keys, both ends, clocks."""
