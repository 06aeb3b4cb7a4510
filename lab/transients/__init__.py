"""Non-line-of-sight imaging from photon transients."""
