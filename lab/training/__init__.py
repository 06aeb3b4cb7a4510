"""Training of the networks and what comes with it; the only rooms with torch are this one and `lab.networks`."""
