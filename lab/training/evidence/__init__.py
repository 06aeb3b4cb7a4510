"""Training of the field and evidence networks, on arrays in memory."""
