"""Buses: the table of topics, the codec, the live bus and the one in process."""
